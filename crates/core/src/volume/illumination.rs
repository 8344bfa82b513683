//! Everything that light does to a volume under a look. Results with different inputs are stored apart, so that a
//! change recomputes only what depends on it.

use std::sync::Arc;

use glam::Vec3;
use rayon::prelude::*;

use super::extinction::{CellSums, Detail, Extinction, Matter, Sheet};
use super::grid::Volume;
use super::lighting::Lighting;
use super::lit::{LIT_MAX, Lit, Shading};
use super::shade::Shade;
use super::world::VoxelBox;
use crate::clip::Region;
use crate::transfer::TransferTable;

/// Brightness of a volume's voxels under a look.
///
/// Light comes from all around (ambient) and from a source (diffuse, by the angle of the gradient). With strengths a
/// of the occlusion O and s of the shadow S, and A = 1 − a·(1 − O), a brightness is
///
/// ambient·A + diffuse·share·((1 − s)·A + s·S):
///
/// the part of the source's light that throws no shadow is occluded like ambient light. Without shading the share is
/// 1, and both lights sum to 1. A surface keeps a part of its unshaded brightness: where a face of the volume cuts a
/// body open, no light reaches its inside.
#[derive(Clone, Debug)]
pub struct Illumination {
    volume: Arc<Volume>,
    shading: Option<Shading>,
    lighting: Lighting,
    /// The inputs of the extinction.
    classes: Arc<Classes>,
    extinction: Option<Arc<(Detail, Extinction)>>,
    gradients: Option<Arc<Lit>>,
    occlusion: Option<GradedShade>,
    shadow: Option<GradedShade>,
    /// Whether the occlusion is that of another look, or missing, until the final one is there.
    lacks_occlusion: bool,
    /// Of a part of a volume, the detail of the shade that is not there before all parts have sent their cells.
    awaits: Option<Detail>,
    lit: Option<Arc<Lit>>,
}

/// The ambient occlusion of a look. A draft of a similar look may borrow it. Clones share it.
#[derive(Clone, Debug)]
pub struct Occlusion(Arc<Shade>);

impl Occlusion {
    /// Whether its volume had as many voxels.
    fn fits(&self, volume: &Volume) -> bool {
        let Shade { dims, voxels, .. } = &*self.0;
        (0..3).all(|axis| dims[axis] == (volume.dims()[axis] as usize).div_ceil(voxels[axis].max(1)))
    }
}

type GradedShade = (Detail, Arc<Shade>);

/// The inputs of extinction: a table's nodes and the map to them, or surfaces; and the region.
#[derive(Debug, PartialEq)]
struct Classes {
    sigma: Vec<f32>,
    x_map: (f32, f32),
    sheets: Option<Vec<Sheet>>,
    region: Region,
}

impl Classes {
    fn of(table: &TransferTable, matter: Matter<'_>, region: &Region) -> Self {
        let x_map = (table.x_scale, table.x_offset);
        let (sigma, sheets) = match matter {
            Matter::Medium(table) => (table.density.iter().map(|node| node[3]).collect(), None),
            Matter::Surfaces(sheets) => (Vec::new(), Some(sheets.to_vec())),
        };
        Self { sigma, x_map, sheets, region: *region }
    }

    /// Whether both attenuate light alike.
    fn shades_like(&self, other: &Self) -> bool {
        let is_alike = self.sheets.is_some() || self.x_map == other.x_map;
        is_alike && self.sigma == other.sigma && self.sheets == other.sheets && self.region == other.region
    }
}

impl Illumination {
    /// Lights a volume in the domain of `table`, where `matter` attenuates light. Matter outside `region`, a part of
    /// its box, throws no shadow. Unchanged results of the same detail and volume are taken from `before`. With it comes
    /// the occlusion that a draft of another look takes.
    #[expect(clippy::too_many_arguments, reason = "each is another thing that brightness depends on")]
    pub fn of(
        volume: &Arc<Volume>,
        table: &TransferTable,
        matter: Matter<'_>,
        shading: Option<Shading>,
        region: &Region,
        lighting: Lighting,
        detail: Detail,
        before: Option<(&Self, Option<&Occlusion>)>,
    ) -> Self {
        let classes = Classes::of(table, matter, region);
        let has_volume = |b: &&Self| Arc::ptr_eq(&b.volume, volume);
        let gradients = shading.map(|shading| {
            let is_same =
                |b: &&Self| has_volume(b) && b.shading == Some(shading) && b.classes.x_map.0 == table.x_scale;
            let kept = before.map(|(b, _)| b).filter(is_same).and_then(|b| b.gradients.clone());
            kept.unwrap_or_else(|| Arc::new(Lit::of(volume, shading, table.x_scale)))
        });
        let mut found = Self {
            volume: volume.clone(),
            shading,
            lighting,
            classes: Arc::new(classes),
            extinction: None,
            occlusion: None,
            shadow: None,
            lacks_occlusion: false,
            awaits: (lighting.is_on() && volume.whole().is_some()).then_some(detail),
            lit: gradients.clone(),
            gradients,
        };
        if lighting.is_on() && found.awaits.is_none() {
            let near = before.and_then(|(_, near)| near).filter(|near| near.fits(volume));
            let before = before.map(|(b, _)| b);
            let alike = before.filter(has_volume).filter(|b| b.classes.shades_like(&found.classes));
            // Occlusion takes long, and that of a look before is near. So an edit does not wait for it.
            let has_own = alike.is_some_and(|b| b.occlusion.is_some() && !b.lacks_occlusion);
            let is_draft_of_other = detail == Detail::Draft && before.is_some() && !has_own;
            let borrowed = is_draft_of_other && (near.is_some() || alike.is_none());
            found.shade(volume, matter, region, detail, (alike, borrowed.then_some(near)));
            let kept = before.filter(|b| found.combines_like(b)).and_then(|b| b.lit.clone());
            let whole = (Vec3::ONE, Vec3::ZERO);
            let combined = || found.combined(volume.dims(), found.gradients.as_deref(), whole);
            found.lit = Some(kept.unwrap_or_else(|| Arc::new(combined())));
        }
        found
    }

    /// `before` has the same extinctions. If `borrowed` is given, the occlusion is that, or there is none.
    fn shade(
        &mut self,
        volume: &Volume,
        matter: Matter<'_>,
        region: &Region,
        detail: Detail,
        (before, borrowed): (Option<&Self>, Option<Option<&Occlusion>>),
    ) {
        let lighting = self.lighting;
        let mut extinction = before.and_then(|b| b.extinction.clone()).filter(|e| e.0 == detail);
        let mut shaded_by = |shade: &dyn Fn(&Extinction) -> Shade| -> GradedShade {
            let found = extinction
                .get_or_insert_with(|| Arc::new((detail, Extinction::of(volume, matter, region, detail))));
            (detail, Arc::new(shade(&found.1)))
        };
        let is_fine = |part: &GradedShade| part.0 == detail || part.0 == Detail::Final;
        if lighting.ambient_occlusion > 0.0 {
            let is_own =
                |b: &&Self| !b.lacks_occlusion && b.lighting.occlusion_radius == lighting.occlusion_radius;
            let kept = before.filter(is_own).and_then(|b| b.occlusion.clone()).filter(is_fine);
            let radius = lighting.occlusion_radius * volume.bounds().radius();
            self.lacks_occlusion = kept.is_none() && borrowed.is_some();
            self.occlusion = kept.or_else(|| match borrowed {
                Some(near) => near.map(|near| (Detail::Draft, near.0.clone())),
                None => Some(shaded_by(&|e| Shade::occlusion(e, radius, detail))),
            });
        }
        if lighting.shadows > 0.0 {
            let source = |l: &Lighting| (l.azimuth_degrees, l.elevation_degrees, l.softness_degrees);
            let kept = before.filter(|b| source(&b.lighting) == source(&lighting));
            let kept = kept.and_then(|b| b.shadow.clone()).filter(is_fine);
            self.shadow = kept.or_else(|| Some(shaded_by(&|e| Shade::shadow(e, &lighting, detail))));
        }
        self.extinction = extinction;
    }

    /// Of a part of a volume that shade is missing for: what the voxels of `own` add to the cells of the light, as words.
    /// `matter` attenuates light, and bodies have the lesser numbers if so.
    pub(crate) fn own_cells(&self, matter: (Matter<'_>, Option<bool>), own: &VoxelBox) -> Option<Vec<u32>> {
        Some(CellSums::of(&self.volume, own, matter, self.awaits?).to_words())
    }

    /// The same with all of its shade, given the box and the words of each part. `None` if one has sent other cells.
    pub(crate) fn with_cells(mut self, parts: &[(VoxelBox, &[u32])]) -> Option<Self> {
        let Some(detail) = self.awaits.take() else { return Some(self) };
        let (lighting, volume) = (self.lighting, self.volume.clone());
        let has_surfaces = self.classes.sheets.is_some();
        let cells = Extinction::of_parts(&volume, parts, has_surfaces, &self.classes.region, detail)?;
        if lighting.ambient_occlusion > 0.0 {
            let radius = lighting.occlusion_radius * volume.bounds().radius();
            self.occlusion = Some((detail, Arc::new(Shade::occlusion(&cells, radius, detail))));
        }
        if lighting.shadows > 0.0 {
            self.shadow = Some((detail, Arc::new(Shade::shadow(&cells, &lighting, detail))));
        }
        let first = Vec3::from_array(volume.first().map(|n| n as f32));
        let lit = self.combined(volume.dims(), self.gradients.as_deref(), (Vec3::ONE, first));
        self.lit = Some(Arc::new(lit));
        Some(self)
    }

    /// The brightness that a march reads; `None` where matter is not lit.
    pub fn lit(&self) -> Option<&Arc<Lit>> {
        self.lit.as_ref()
    }

    /// The same with the brightness of other voxels, such as those of a finer level.
    pub fn with_lit(&self, lit: Option<Arc<Lit>>) -> Self {
        Self { lit, ..self.clone() }
    }

    /// The ambient occlusion, of this look or borrowed from another.
    pub fn occlusion(&self) -> Option<Occlusion> {
        self.occlusion.as_ref().map(|part| Occlusion(part.1.clone()))
    }

    /// Whether the shade has its final detail, or there is none.
    pub fn is_final(&self) -> bool {
        !self.lacks_occlusion
            && self.awaits != Some(Detail::Draft)
            && [&self.occlusion, &self.shadow].into_iter().flatten().all(|part| part.0 == Detail::Final)
    }

    /// Brightness of matter without ambient occlusion and shadows, as ambient and diffuse. `None` where there are none
    /// of both, or no shading.
    pub fn open(&self) -> Option<(f32, f32)> {
        self.shading.filter(|_| self.lighting.is_on()).map(|s| (s.ambient, s.diffuse))
    }

    /// Whether [`Self::combined`] has the same inputs.
    fn combines_like(&self, other: &Self) -> bool {
        let strengths = |i: &Self| (i.lighting.ambient_occlusion, i.lighting.shadows);
        let is_same = |a: &Option<GradedShade>, b: &Option<GradedShade>| match (a, b) {
            (Some((_, a)), Some((_, b))) => Arc::ptr_eq(a, b),
            (a, b) => a.is_none() && b.is_none(),
        };
        let has_same_gradients = match (&self.gradients, &other.gradients) {
            (Some(a), Some(b)) => Arc::ptr_eq(a, b),
            (a, b) => a.is_none() && b.is_none(),
        };
        has_same_gradients
            && strengths(self) == strengths(other)
            && self.classes.sheets.is_some() == other.classes.sheets.is_some()
            && is_same(&self.occlusion, &other.occlusion)
            && is_same(&self.shadow, &other.shadow)
    }

    /// The brightness of the voxels of a page of the same volume, whose matter has `table`; `None` where matter is not
    /// lit. Shade is that of the whole volume.
    pub fn of_page(&self, page: &Volume, table: &TransferTable) -> Option<Lit> {
        self.lit.as_ref()?;
        let gradients = self.shading.map(|shading| Lit::of(page, shading, table.x_scale));
        if !self.lighting.is_on() {
            return gradients;
        }
        let scale = page.spacing() / self.volume.spacing();
        let offset = self.volume.voxel_origin() - page.voxel_origin() * scale;
        Some(self.combined(page.dims(), gradients.as_ref(), (scale, offset)))
    }

    /// The brightness of every voxel, as one number. `place` leads from their voxel space to that of the shaded
    /// volume: a factor and an offset.
    fn combined(&self, dims: [u32; 3], gradients: Option<&Lit>, place: (Vec3, Vec3)) -> Lit {
        let [nx, ny, nz] = dims.map(|d| d as usize);
        let (ambient, diffuse) =
            self.shading.map_or((UNSHADED_AMBIENT, 1.0 - UNSHADED_AMBIENT), |s| (s.ambient, s.diffuse));
        let whole = ambient + diffuse;
        let Lighting { ambient_occlusion: a, shadows: s, .. } = self.lighting;
        let unit = LIT_MAX / whole;
        let least = if self.classes.sheets.is_some() { LEAST_OF_SURFACES } else { 0.0 };
        let mut shares = vec![0u8; nx * ny * nz];
        shares.par_chunks_mut(nx * ny).enumerate().for_each(|(z, slice)| {
            let mut occlusion = self.occlusion.as_ref().map(|part| ShadeRows::new(&part.1, nx, place));
            let mut shadow = self.shadow.as_ref().map(|part| ShadeRows::new(&part.1, nx, place));
            for (y, out) in slice.chunks_mut(nx).enumerate() {
                let open = occlusion.as_mut().map_or(&[][..], |rows| rows.at(y, z));
                let lit = shadow.as_mut().map_or(&[][..], |rows| rows.at(y, z));
                let gradients = gradients.map_or(&[][..], |g| &g.shares[(z * ny + y) * nx..][..nx]);
                for (x, out) in out.iter_mut().enumerate() {
                    let open = open.get(x).map_or(1.0, |o| 1.0 - a * (1.0 - o));
                    let lit = lit.get(x).map_or(1.0, |lit| *lit);
                    let share = gradients.get(x).map_or(1.0, |g| f32::from(*g) * (1.0 / LIT_MAX));
                    let brightness = ambient * open + diffuse * share * ((1.0 - s) * open + s * lit);
                    let brightness = brightness.max(least * (ambient + diffuse * share));
                    *out = (brightness * unit + 0.5) as u8;
                }
            }
        });
        Lit { shares, ambient: 0.0, diffuse: whole }
    }
}

/// A shade at the centres of voxels, row by row.
struct ShadeRows<'a> {
    shade: &'a Shade,
    /// From the voxels' own space to that of the shade: a factor and an offset.
    place: (Vec3, Vec3),
    /// For each voxel, the cell before it and the weight of the next.
    places: Vec<(u32, f32)>,
    across: Vec<f32>,
    row: Vec<f32>,
}

impl<'a> ShadeRows<'a> {
    fn new(shade: &'a Shade, nx: usize, place: (Vec3, Vec3)) -> Self {
        let places = (0..nx).map(|x| {
            let (cell, part) = cell(shade, place, 0, x);
            (cell as u32, part)
        });
        let (places, across, row) = (places.collect(), vec![0.0; shade.dims[0] + 1], vec![0.0; nx]);
        Self { shade, place, places, across, row }
    }

    fn at(&mut self, y: usize, z: usize) -> &[f32] {
        let [cx, cy, cz] = self.shade.dims;
        let ((j, ty), (k, tz)) = (cell(self.shade, self.place, 1, y), cell(self.shade, self.place, 2, z));
        let line = |j: usize, k: usize| &self.shade.shares[(k.min(cz - 1) * cy + j.min(cy - 1)) * cx..][..cx];
        let lines = line(j, k).iter().zip(line(j + 1, k)).zip(line(j, k + 1).iter().zip(line(j + 1, k + 1)));
        for (across, ((a, b), (c, d))) in self.across.iter_mut().zip(lines) {
            let (near, far) = (a + (b - a) * ty, c + (d - c) * ty);
            *across = near + (far - near) * tz;
        }
        // Beyond the centre of the last cell its value continues.
        self.across[cx] = self.across[cx - 1];
        for (out, &(cell, part)) in self.row.iter_mut().zip(&self.places) {
            let (a, b) = (self.across[cell as usize], self.across[cell as usize + 1]);
            *out = a + (b - a) * part;
        }
        &self.row
    }
}

/// The cells around the centre of a voxel along an axis.
fn cell(shade: &Shade, (scale, offset): (Vec3, Vec3), axis: usize, voxel: usize) -> (usize, f32) {
    let p = (voxel as f32 + 0.5) * scale[axis] + offset[axis];
    let at = (p / shade.voxels[axis] as f32 - 0.5).max(0.0).min(shade.dims[axis] as f32 - 1.0);
    (at as usize, at.fract())
}

/// Ambient fraction of light for unshaded matter where shade is shown: that of shaded matter facing the light.
const UNSHADED_AMBIENT: f32 = 0.25;
/// Least fraction of its unshaded brightness that a surface keeps: a third of it in sRGB.
const LEAST_OF_SURFACES: f32 = 0.1;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::march::{MarchSettings, Scene};
    use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
    use crate::volume::procedural::Builtin;

    fn transfer(opacity: f32) -> TransferFunction {
        let p = |x, opacity| ControlPoint { x, color: [1.0; 3], opacity };
        TransferFunction {
            name: "step".into(),
            domain: Domain::Full,
            unit_length: UnitLength::Radius(0.1),
            points: vec![p(0.0, 0.0), p(0.3, 0.0), p(0.4, opacity), p(1.0, opacity)],
        }
    }

    fn scene(shaded: bool, lighting: Lighting) -> Scene {
        let volume = Arc::new(Builtin::Cubus.volume(24));
        Scene::new(volume, &transfer(0.9), MarchSettings::of(shaded, lighting))
    }

    const OFF: Lighting = Lighting {
        ambient_occlusion: 0.0,
        occlusion_radius: 0.3,
        shadows: 0.0,
        softness_degrees: 20.0,
        azimuth_degrees: 10.0,
        elevation_degrees: 60.0,
        specular: 0.0,
        shininess: 20.0,
    };

    #[test]
    fn without_shade_nothing_is_changed() {
        let shaded = scene(true, OFF);
        let shading = Shading { light: OFF.direction(), ..Shading::default() };
        let plain = Lit::of(&shaded.volume, shading, shaded.table.x_scale);
        assert_eq!(shaded.illumination.lit().map(|l| &**l), Some(&plain));
        assert!(scene(false, OFF).illumination.lit().is_none());
        assert!(shaded.illumination.is_final());
    }

    #[test]
    fn a_brightness_is_what_the_formula_says() {
        let lighting = Lighting { ambient_occlusion: 0.7, shadows: 0.6, ..OFF };
        for shaded in [true, false] {
            let scene = scene(shaded, lighting);
            let found = &scene.illumination;
            let (open, lit) = (&found.occlusion.as_ref().unwrap().1, &found.shadow.as_ref().unwrap().1);
            assert_eq!(open.dims, [24; 3], "a cell a voxel");
            let (ambient, diffuse) = if shaded { (0.25, 0.85) } else { (0.25, 0.75) };
            let whole = scene.illumination.lit().unwrap();
            assert_eq!((whole.ambient, whole.diffuse), (0.0, ambient + diffuse));
            let mut darkest = 1f32;
            for i in 0..24 * 24 * 24 {
                let share = found.gradients.as_ref().map_or(1.0, |g| f32::from(g.shares[i]) / LIT_MAX);
                let open = 1.0 - 0.7 * (1.0 - open.shares[i]);
                let exact = ambient * open + diffuse * share * (0.4 * open + 0.6 * lit.shares[i]);
                let got = whole.diffuse * f32::from(whole.shares[i]) / LIT_MAX;
                // Half of a unit.
                assert!((got - exact).abs() <= 0.502 * whole.diffuse / LIT_MAX, "{i}: {got} for {exact}");
                darkest = darkest.min(got);
            }
            assert!(darkest < 0.5 * (ambient + diffuse), "there is shade: {darkest}");
        }
    }

    #[test]
    fn only_what_changes_is_worked_out_again() {
        let lighting = Lighting { ambient_occlusion: 1.0, shadows: 1.0, ..OFF };
        let first = scene(true, lighting);
        let with = |lighting| first.with_look(&transfer(0.9), MarchSettings::of(true, lighting)).illumination;
        let same = |a: &Option<GradedShade>, b: &Option<GradedShade>| match (a, b) {
            (Some(a), Some(b)) => Arc::ptr_eq(&a.1, &b.1),
            _ => false,
        };
        let weaker = with(Lighting { ambient_occlusion: 0.5, ..lighting });
        assert!(same(&weaker.occlusion, &first.illumination.occlusion));
        assert!(same(&weaker.shadow, &first.illumination.shadow));
        assert_ne!(weaker.lit(), first.illumination.lit());
        // Highlights use the brightness that is there.
        let glossy = with(Lighting { specular: 0.5, shininess: 60.0, ..lighting });
        assert!(Arc::ptr_eq(glossy.lit().unwrap(), first.illumination.lit().unwrap()));
        assert!(!Arc::ptr_eq(weaker.lit().unwrap(), first.illumination.lit().unwrap()));
        let turned = with(Lighting { azimuth_degrees: 50.0, ..lighting });
        assert!(same(&turned.occlusion, &first.illumination.occlusion));
        assert!(!same(&turned.shadow, &first.illumination.shadow));
        // Another transfer function, another shade; and each is what a fresh scene has.
        let settings = MarchSettings::of(true, lighting);
        let softer = first.with_look(&transfer(0.2), settings);
        assert!(!same(&softer.illumination.occlusion, &first.illumination.occlusion));
        let fresh = Scene::new(first.volume.clone(), &transfer(0.2), settings);
        assert_eq!(softer.illumination.lit(), fresh.illumination.lit());
        assert_eq!(
            turned.lit(),
            scene(true, Lighting { azimuth_degrees: 50.0, ..lighting }).illumination.lit()
        );
    }

    #[test]
    fn what_is_cut_away_throws_no_shade() {
        use crate::clip::{Clip, Plane};
        let lighting = Lighting { ambient_occlusion: 1.0, shadows: 1.0, ..OFF };
        let whole = scene(false, lighting);
        // The light comes from above: without the upper half, what is left of the lower stands in the light.
        let plane = Plane::new(Vec3::NEG_Y, 0.0);
        let with = |clip| {
            let settings = MarchSettings { clip, ..MarchSettings::of(false, lighting) };
            whole.with_look(&transfer(0.9), settings).illumination
        };
        let cut = with(Clip { plane, ..Clip::default() });
        let below = |i: usize| i / 24 % 24 < 12;
        let sum = |l: &Illumination| -> u64 {
            let shares = &l.lit().unwrap().shares;
            shares.iter().enumerate().filter(|(i, _)| below(*i)).map(|(_, s)| u64::from(*s)).sum()
        };
        let (before, after) = (sum(&whole.illumination), sum(&cut));
        assert!(after > before + before / 20, "{after} of {before}");
        // Negative control: a plane that cuts nothing away, and none.
        let far = Plane::new(Vec3::NEG_Y, -100.0);
        assert_eq!(sum(&with(Clip { plane: far, ..Clip::default() })), before);
        // Nothing left, nothing dark.
        let none = with(Clip { plane: Plane::new(Vec3::Y, 100.0), ..Clip::default() });
        assert!(none.lit().unwrap().shares.iter().all(|s| *s >= 254));
    }

    #[test]
    fn a_draft_is_near_and_is_called_one() {
        let volume = Arc::new(Builtin::Shells.volume(72));
        let lighting = Lighting { ambient_occlusion: 1.0, shadows: 1.0, ..OFF };
        let settings = MarchSettings::of(true, lighting);
        let whole = Scene::new(volume.clone(), &transfer(0.5), settings);
        let in_draft = MarchSettings { detail: Detail::Draft, ..settings };
        // What is fine already stays so.
        assert!(whole.with_look(&transfer(0.5), in_draft).illumination.is_final());
        let draft = Scene::new(volume.clone(), &transfer(0.5), in_draft);
        assert!(!draft.with_look(&transfer(0.5), in_draft).illumination.is_final());
        assert!(draft.with_look(&transfer(0.5), settings).illumination.is_final());
        assert!(whole.illumination.is_final() && !draft.illumination.is_final());
        let mean = |a: &Lit, b: &Lit| {
            let sum: u64 = a.shares.iter().zip(&b.shares).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
            sum as f64 / a.shares.len() as f64
        };
        let (a, b) = (whole.illumination.lit().unwrap(), draft.illumination.lit().unwrap());
        let none = scene_of(&volume, MarchSettings::of(true, OFF));
        let plain = none.illumination.gradients.as_ref().unwrap();
        assert!(mean(a, b) < 0.25 * mean(a, plain), "{} of {}", mean(a, b), mean(a, plain));
    }

    #[test]
    fn a_draft_of_another_look_takes_the_occlusion_that_is_there() {
        let lighting = Lighting { ambient_occlusion: 1.0, ..OFF };
        let settings = MarchSettings::of(true, lighting);
        let in_draft = MarchSettings { detail: Detail::Draft, ..settings };
        let (bare, lit) = (scene(true, OFF), scene(true, lighting));
        // None yet: the draft is as bright as without, and no final.
        let first = bare.with_look(&transfer(0.2), in_draft).illumination;
        assert!(first.occlusion().is_none() && !first.is_final());
        let draft = lit.with_look(&transfer(0.2), in_draft);
        let shared = |l: &Illumination| Arc::as_ptr(&l.occlusion.as_ref().unwrap().1);
        assert_eq!(shared(&draft.illumination), shared(&lit.illumination));
        assert!(!draft.illumination.is_final());
        // A caller may name another one, or none, whatever this scene has.
        let far = Scene::new(lit.volume.clone(), &transfer(0.01), settings).illumination;
        let near = lit.with_look_near(&transfer(0.2), in_draft, far.occlusion().as_ref());
        assert_eq!(shared(&near.illumination), shared(&far));
        let none = lit.with_look_near(&transfer(0.2), in_draft, None).illumination;
        assert!(none.occlusion().is_none() && !none.is_final());
        // What is borrowed is nobody's own: a look like the draft's borrows anew.
        let again = draft.with_look_near(&transfer(0.2), in_draft, far.occlusion().as_ref());
        assert_eq!(shared(&again.illumination), shared(&far));
        // In the end, each has its own.
        let own = draft.with_look(&transfer(0.2), settings).illumination;
        assert!(own.is_final() && shared(&own) != shared(&lit.illumination));
        assert_eq!(own.lit(), Scene::new(lit.volume.clone(), &transfer(0.2), settings).illumination.lit());
    }

    fn scene_of(volume: &Arc<Volume>, settings: MarchSettings) -> Scene {
        Scene::new(volume.clone(), &transfer(0.5), settings)
    }

    #[test]
    fn voxels_of_any_size_and_shape_are_lit() {
        use crate::volume::{VolumeInfo, Voxels};
        for (dims, spacing) in [
            ([1, 1, 1], Vec3::ONE),
            ([2, 1, 3], Vec3::new(1e-9, 1e-6, 1e-7)),
            ([70, 3, 2], Vec3::new(1e9, 1e8, 1e11)),
            ([300, 300, 30], Vec3::new(0.5, 0.5, 5.0)),
        ] {
            let n = dims.iter().product::<u32>();
            let voxels = Voxels::U16((0..n).map(|i| (i.wrapping_mul(40_503) >> 3) as u16).collect());
            let volume = Volume::new(dims, spacing, voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
            let lighting = Lighting { ambient_occlusion: 1.0, shadows: 1.0, ..OFF };
            for detail in [Detail::Draft, Detail::Final] {
                let settings = MarchSettings { detail, ..MarchSettings::of(true, lighting) };
                let scene = Scene::new(Arc::new(volume.clone()), &transfer(0.9), settings);
                let lit = scene.illumination.lit().unwrap();
                assert_eq!(lit.shares.len() as u32, n);
                assert!(lit.shares.iter().any(|s| *s > 20), "{dims:?} {spacing}: all dark");
            }
        }
    }
}
