//! BigDataViewer (`.h5` and `.xml`): arrays for each point in time, setup and level. Setups of one view are channels.

use super::bdv_xml::{BdvXml, Setup};
use super::contents::ArrayFile;
use super::image::{ArrayImage, PartLevel, PartNames};
use super::storage::StorageForm;
use crate::axes::Geometry;
use crate::dtype::{Dtype, Endian};
use crate::error::one_line;
use crate::plan::{Axis, Plan};

/// Setups that are shown together: those of one view, size and type.
struct View {
    /// Their numbers.
    setups: Vec<u32>,
    kind: ViewKind,
    spacing: Option<[f64; 3]>,
    unit: Option<&'static str>,
    channel_names: Vec<String>,
}

/// What the setups of a view have in common.
#[derive(PartialEq)]
struct ViewKind {
    dims: [u64; 3],
    dtype: (Dtype, Endian),
    /// Angle, illumination and tile.
    view: Vec<(String, String)>,
}

/// The images of a file, with a name of each; none if it is not of BigDataViewer. `xml` is its description.
pub(super) fn images(contents: &ArrayFile, xml: Option<&BdvXml>) -> Vec<(String, ArrayImage)> {
    let times = contents.numbers_after("/", "t");
    let setups = contents.numbers_after("/", "s");
    let Some(first_time) = times.first() else { return Vec::new() };
    let mut views: Vec<View> = Vec::new();
    for setup in setups.into_iter().take(MAX_SETUPS) {
        let Some((kind, told)) = setup_kind(contents, *first_time, setup, xml) else { continue };
        let name = match (xml, told) {
            (Some(xml), Some(told)) => xml.channel_name(told),
            _ => String::new(),
        };
        match views.iter_mut().find(|view| view.kind == kind) {
            Some(view) => {
                view.setups.push(setup);
                view.channel_names.push(one_line(&name));
            }
            None => views.push(View {
                setups: vec![setup],
                kind,
                spacing: told.and_then(|told| told.spacing),
                unit: told.and_then(|told| told.unit),
                channel_names: vec![one_line(&name)],
            }),
        }
    }
    views.into_iter().map(|view| (view.name(), view.image(contents, &times))).collect()
}

/// What a setup is, and what the description says of it; `None` if its finest level is no volume.
fn setup_kind<'a>(
    contents: &ArrayFile,
    time: u32,
    setup: u32,
    xml: Option<&'a BdvXml>,
) -> Option<(ViewKind, Option<&'a Setup>)> {
    let names = PartNames::BigDataViewer { levels: vec![0], times: vec![time], setups: vec![setup] };
    let array = contents.array(&names.path(0, 0, 0)).ok()?;
    StorageForm::of(contents, &array).ok()?;
    let ([z, y, x], (dtype, endian)) = (array.shape[..].try_into().ok()?, array.kind.ok()?);
    let told = xml.and_then(|xml| xml.setup(setup));
    let mut view = told.map(|told| told.view.clone()).unwrap_or_default();
    view.sort();
    Some((ViewKind { dims: [x, y, z], dtype: (names.dtype(dtype), endian), view }, told))
}

impl View {
    /// Its name in the list of images.
    fn name(&self) -> String {
        let [x, y, z] = self.kind.dims;
        let view = self.kind.view.iter().map(|(what, id)| format!(", {what} {id}")).collect::<String>();
        let last = self.setups.last().copied().unwrap_or(0);
        one_line(&format!(
            "setups {} to {last}{view} ({x}×{y}×{z} {})",
            self.setups[0],
            self.kind.dtype.0.name()
        ))
    }

    fn image(self, contents: &ArrayFile, times: &[u32]) -> ArrayImage {
        let (levels, steps) = levels(contents, times[0], self.setups[0], self.kind.dims);
        let (dtype, endian) = self.kind.dtype;
        let unit = self.spacing.and(self.unit).map(str::to_owned);
        let geometry = Geometry::of_image(self.spacing.unwrap_or([1.0; 3]), unit);
        let axes = Axis::in_space(self.kind.dims);
        let mut plan = Plan::new("BigDataViewer", dtype, endian, axes, geometry);
        if self.spacing.is_none() {
            let text = "no .xml beside the file tells its spacing; it was taken as 1";
            plan.spacing_guess = Some(text.into());
        }
        let (num_channels, num_times) = (self.setups.len(), times.len());
        if num_channels > 1 {
            plan.channel_names = self.channel_names;
        }
        let names = PartNames::BigDataViewer { levels, times: times.to_vec(), setups: self.setups };
        ArrayImage::new(plan, (num_channels, num_times), steps, names).with_joint_channels()
    }
}

/// The numbers of the levels of a setup, and how each lies in the finest.
fn levels(contents: &ArrayFile, time: u32, setup: u32, finest: [u64; 3]) -> (Vec<u32>, Vec<PartLevel>) {
    // Along x, y and z, for each level.
    let factors = contents.numbers(&format!("/s{setup:02}/resolutions")).unwrap_or_default();
    let (mut numbers, mut levels) = (Vec::new(), Vec::new());
    for number in contents.numbers_after(&format!("/t{time:05}/s{setup:02}"), "").into_iter().take(MAX_LEVELS)
    {
        let names = PartNames::BigDataViewer { levels: vec![number], times: vec![time], setups: vec![setup] };
        let Ok(array) = contents.array(&names.path(0, 0, 0)) else { continue };
        let Ok([z, y, x]) = <[u64; 3]>::try_from(array.shape) else { continue };
        let dims = [x, y, z];
        let told = factors.get(3 * number as usize..3 * number as usize + 3);
        let told = told.filter(|_| factors.len() >= 3 && factors[..3].iter().all(|factor| *factor > 0.0));
        let step = [0, 1, 2].map(|i| match told {
            Some(told) if told[i] >= factors[i] => told[i] / factors[i],
            _ => (finest[i] as f64 / dims[i].max(1) as f64).round().max(1.0),
        });
        numbers.push(number);
        levels.push(PartLevel { dims, step });
    }
    (numbers, levels)
}

const MAX_SETUPS: usize = 4096;
const MAX_LEVELS: usize = 64;
