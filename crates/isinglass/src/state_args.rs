//! `--state`: a command uses a saved state, and given flags override it.

use std::path::Path;

use anyhow::{Context, Result, bail};
use clap::Args;
use glam::{Quat, Vec3};
use isinglass_bench::progress::note;
use isinglass_client::Bindings;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::channels::Channels;
use isinglass_core::look::Look;
use isinglass_core::mode::{Iso, Mode};
use isinglass_core::orbit::Orbit;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::{Detail, Lighting, Volume};
use isinglass_formats::OpenedScene;
use isinglass_formats::{
    ReadState, Remembered, SavedCamera, SavedState, SavedVolume, Srgb, StereoPicture, is_address, read_state,
    state_from_link, state_to_link,
};
use isinglass_net::{Link, state_of_link};

use crate::args::{ListArgs, LookArgs, ViewArgs, VolumeArgs, open_to_serve, open_volume, orthographic};
use crate::given::Given;
use crate::library::OpenedFile;
use crate::memory::MemoryArgs;
use crate::window_args::WindowArgs;

#[derive(Args, Clone, Debug)]
pub(crate) struct StateArgs {
    /// Use a saved state: a file of the viewer's, or a link that it copied. Flags override it
    #[arg(long, value_name = "FILE|LINK")]
    state: Option<String>,
}

impl StateArgs {
    /// Whether a state was named.
    pub(crate) fn is_some(&self) -> bool {
        self.state.is_some()
    }

    pub(crate) fn text(&self) -> Option<&str> {
        self.state.as_deref()
    }

    /// Reads the named state, or else the one in a link that is followed.
    pub(crate) fn read_or(&self, of_link: Option<&str>, given: Given) -> Result<Seen> {
        match (&self.state, of_link) {
            (None, Some(text)) => Ok(Seen::of(state_from_link(text)?, given)),
            _ => self.read(given),
        }
    }

    /// Reads the state. Unknown parts are reported on standard error.
    pub(crate) fn read(&self, given: Given) -> Result<Seen> {
        let Some(text) = &self.state else { return Ok(Seen { state: SavedState::default(), given }) };
        let read = if text.trim_start().starts_with("isinglass://") {
            state_from_link(&state_of_link(text)?)?
        } else if is_address(text) {
            bail!(
                "--state: found an address of the web, expected a file or a link; download it first, and name the file"
            );
        } else {
            read_state(Path::new(text))?
        };
        Ok(Seen::of(read, given))
    }
}

/// What to show: a state with given flags on top.
pub(crate) struct Seen {
    /// The state; empty without `--state`.
    pub(crate) state: SavedState,
    /// The given flags.
    given: Given,
}

impl Seen {
    fn of(read: ReadState, given: Given) -> Self {
        if let Some(unknown) = read.note {
            note(&unknown);
        }
        Self { state: read.state, given }
    }

    pub(crate) fn given(&self) -> &Given {
        &self.given
    }

    /// Whether a flag was given that changes the look.
    pub(crate) fn has_flags_of_look(&self) -> bool {
        OF_LOOK.iter().chain(&OF_LIGHT).any(|field| self.given.has(field))
    }

    /// Whether a flag was given, or the state has a look, so that the light is chosen.
    pub(crate) fn has_flags_of_light(&self) -> bool {
        self.state.look.is_some() || OF_LIGHT.iter().any(|field| self.given.has(field))
    }

    /// Names of possible input files for a picture.
    pub(crate) fn inputs<'a>(
        &'a self,
        volume: &'a VolumeArgs,
        state: &'a StateArgs,
        look: &'a LookArgs,
    ) -> [Option<&'a str>; 3] {
        let source = || self.state.volume.as_ref()?.source.as_deref();
        [volume.volume.as_deref().or_else(source), state.text(), look.transfer_file()]
    }

    /// Notes parts of a state that no rendering shows.
    pub(crate) fn note_what_is_not_drawn(&self, has_two_eyes: bool) {
        if self.state.view.stereo.is_some_and(|s| s != StereoPicture::Off) && !has_two_eyes {
            note("note: the state is of two eyes, and one is drawn; see --stereo");
        }
    }

    /// The named volume, or else the state's.
    pub(crate) fn volume(&self, volume: &VolumeArgs) -> Result<VolumeArgs> {
        if volume.volume.is_some() {
            return Ok(volume.clone());
        }
        let saved = self.state.volume.as_ref();
        let of_link = self.server()?;
        let server = of_link.as_deref().or(saved.and_then(|v| v.server.as_deref()));
        let source = saved.map(SavedVolume::source_to_open).transpose().map_err(anyhow::Error::msg)?;
        let source = source.flatten().with_context(|| match server {
            Some(server) => format!("the state's volume is shown by {server}, expected VOLUME"),
            None => "the state does not say where its volume is, expected VOLUME".into(),
        })?;
        Ok(volume.in_state(source))
    }

    /// The server of the state's volume, if its source is a link to one.
    ///
    /// # Errors
    /// It is no good link.
    pub(crate) fn server(&self) -> Result<Option<String>> {
        let Some(link) = self.state.volume.as_ref().and_then(SavedVolume::link) else { return Ok(None) };
        let link: Link = link.parse().context("the link of the state's volume")?;
        Ok(Some(link.place()))
    }

    /// Opens a volume with its look. Notes if it is not the state's volume.
    pub(crate) fn open(
        &self,
        volume: &VolumeArgs,
        look: &LookArgs,
        lighting: Lighting,
        lists: &ListArgs,
        memory: &MemoryArgs,
    ) -> Result<(OpenedScene, Look)> {
        let opened = open_volume(&self.volume(volume)?, look, lighting, memory)?;
        let (opened, wanted) = self.under_look(opened, look, lighting, lists)?;
        self.note_oddities(opened.scene.whole(), &wanted);
        Ok((opened, wanted))
    }

    /// A volume that was opened with flags, under the look that is wanted.
    pub(crate) fn under_look(
        &self,
        mut opened: OpenedScene,
        look: &LookArgs,
        lighting: Lighting,
        lists: &ListArgs,
    ) -> Result<(OpenedScene, Look)> {
        let upright = lighting.upright(opened.scene.volume.info.orientation.as_deref());
        let classes = (opened.transfer.clone(), opened.channels.clone());
        let wanted = self.look(classes, look, upright, lists)?;
        if self.state.look.is_some() || upright != lighting {
            opened.scene = opened.scene.under(&wanted, Detail::Final, None);
            (opened.transfer, opened.channels) = (wanted.transfer.clone(), wanted.channels.clone());
        }
        Ok((opened, wanted))
    }

    /// The same for a server.
    pub(crate) fn open_to_serve(
        &self,
        volume: &VolumeArgs,
        look: &LookArgs,
        lighting: Lighting,
        lists: &ListArgs,
        memory: &MemoryArgs,
    ) -> Result<(OpenedFile, Look)> {
        let opened = open_to_serve(&self.volume(volume)?, look, memory)?;
        let wanted = self.look_at(&opened, look, lighting, lists)?;
        Ok((opened, wanted))
    }

    /// The look of a volume that was opened for a server. Notes if it is not the state's volume.
    pub(crate) fn look_at(
        &self,
        opened: &OpenedFile,
        look: &LookArgs,
        lighting: Lighting,
        lists: &ListArgs,
    ) -> Result<Look> {
        let lighting = lighting.upright(opened.volume.info.orientation.as_deref());
        let classes = (opened.transfer.clone(), opened.channels.clone());
        let wanted = self.look(classes, look, lighting, lists)?;
        self.note_oddities(&opened.volume, &wanted);
        Ok(wanted)
    }

    /// Notes what a viewer of this volume and look should know.
    pub(crate) fn note_oddities(&self, volume: &Volume, look: &Look) {
        volume.info.warnings.iter().for_each(|warning| note(&format!("note: {warning}")));
        if let Some(difference) = self.state.volume.as_ref().and_then(|v| v.difference_from(volume)) {
            note(&difference);
        }
        let (least, greatest) = volume.value_range();
        let isos = look.isos.as_slice();
        let is_outside = |iso: &Iso| iso.value <= least || iso.value > greatest;
        if look.mode == Mode::Iso && !isos.is_empty() && isos.iter().all(is_outside) {
            note(&format!("note: no surface is there: the values lie between {least} and {greatest}"));
        }
    }

    fn look(
        &self,
        (transfer, channels): (TransferFunction, Channels),
        look: &LookArgs,
        lighting: Lighting,
        lists: &ListArgs,
    ) -> Result<Look> {
        let of_flags = Look { lighting, ..look.look(transfer, channels, lists)? };
        Ok(match self.state.look.clone() {
            Some(saved) => self.merged(saved, of_flags),
            None => of_flags,
        })
    }

    /// The state's look with the given fields of `flags`.
    fn merged(&self, saved: Look, flags: Look) -> Look {
        // Destructuring makes sure that a new field gets its flag here.
        let Look { transfer, shaded, lighting, k, clip, mode, isos, channels } = flags;
        let mut look = saved;
        // A state without looks of channels leaves them as they are.
        if look.channels == Channels::default() {
            look.channels = channels;
        }
        let has = |field| {
            debug_assert!(OF_LOOK.contains(&field) || OF_LIGHT.contains(&field), "{field}");
            self.given.has(field)
        };
        if has("tf") {
            look.transfer = transfer;
        }
        if has("shading") {
            look.shaded = shaded;
        }
        if has("ambient_occlusion") {
            look.lighting.ambient_occlusion = lighting.ambient_occlusion;
        }
        if has("occlusion_radius") {
            look.lighting.occlusion_radius = lighting.occlusion_radius;
        }
        if has("shadows") {
            look.lighting.shadows = lighting.shadows;
        }
        if has("softness") {
            look.lighting.softness_degrees = lighting.softness_degrees;
        }
        if has("light") {
            let Lighting { azimuth_degrees, elevation_degrees, .. } = lighting;
            look.lighting = Lighting { azimuth_degrees, elevation_degrees, ..look.lighting };
        }
        if has("specular") {
            look.lighting.specular = lighting.specular;
        }
        if has("shininess") {
            look.lighting.shininess = lighting.shininess;
        }
        if has("k") {
            look.k = k;
        }
        if has("mode") || has("iso") {
            look.mode = mode;
        }
        if has("iso") {
            look.isos = isos;
        }
        if has("clip_box") {
            look.clip.bounds = clip.bounds;
        }
        if has("clip_plane") {
            look.clip.plane = clip.plane;
        }
        look
    }

    /// The camera over a volume in `bounds`: the state's with given size and field of view, or else that of `orbit`;
    /// turned by `degrees` around the vertical.
    pub(crate) fn camera(&self, orbit: &Orbit, degrees: f32, view: &ViewArgs, bounds: &Aabb) -> Camera {
        let flags = view.intrinsics();
        let orbit = orbit.turned(degrees);
        let is_parallel = view.orthographic || self.state.view.orthographic == Some(true);
        let around = |intrinsics| {
            let camera = orbit.camera(intrinsics, bounds);
            if is_parallel { orthographic(&camera, bounds) } else { camera }
        };
        let Some(saved) = &self.state.camera else { return around(flags) };
        let of_state = saved.intrinsics();
        let size = if self.given.has("size") { flags } else { of_state };
        let projection = if self.given.has("fov") { flags.projection } else { of_state.projection };
        let intrinsics = Intrinsics { projection, ..size };
        if self.given.has("orbit") {
            return around(intrinsics);
        }
        let camera = Camera::new(
            turned(saved.pose(), orbit.world_from_angles * Vec3::Y, degrees, bounds),
            intrinsics,
            bounds,
        );
        // The size matches the viewer's at the depth of the camera's centre of rotation.
        let (_, eye_from_center) = saved.placement();
        if is_parallel { camera.to_orthographic(eye_from_center.z.abs(), bounds) } else { camera }
    }

    pub(crate) fn background(&self, flag: [u8; 3]) -> [u8; 3] {
        match self.state.view.background {
            Some(Srgb(rgb)) if !self.given.has("background") => rgb,
            _ => flag,
        }
    }

    /// The state for links to a server whose look is `look`. It leaves out the look, which the server decides, and
    /// the volume's path on its disk, which is private.
    pub(crate) fn for_link(&self, look: &Look) -> Option<String> {
        let volume = self.state.volume.clone().map(SavedVolume::without_place);
        let state = SavedState { volume, look: Some(look.clone()), ..self.state.clone() };
        (self.state != SavedState::default()).then(|| state_to_link(&state))
    }

    /// Keys and mouse of a window.
    pub(crate) fn bindings(&self) -> Bindings {
        self.given.bindings.clone()
    }

    /// For a window: its size, from a flag, the state or the person's choices, and whether it is the state's; and the
    /// state merged with flags and choices.
    pub(crate) fn window(
        &self,
        size: [u32; 2],
        fov_degrees: f32,
        window: &WindowArgs,
        choices: &Remembered,
    ) -> (([u32; 2], bool), SavedState) {
        let mut state = self.state.clone();
        let of_state = state.camera.map(|camera| camera.size).filter(|_| !self.given.has("size"));
        let has = |field| self.given.has(field);
        if has("fov") {
            state.camera = state.camera.map(|c| SavedCamera { fov_degrees: fov_degrees.into(), ..c });
        }
        state.camera = state.camera.filter(|_| !has("orbit"));
        state.view.orthographic = state.view.orthographic.filter(|_| !has("orthographic"));
        let has = |field: &str| self.given.has(field);
        state.view = window.view(state.view, &choices.view, has);
        let chosen = choices.size.filter(|_| !has("size")).unwrap_or(size);
        ((of_state.unwrap_or(chosen), of_state.is_some()), state)
    }
}

/// A pose turned about the axis `up` through the volume's middle.
fn turned(pose: Pose, up: Vec3, degrees: f32, bounds: &Aabb) -> Pose {
    if degrees == 0.0 {
        return pose;
    }
    let (turn, center) = (Quat::from_axis_angle(up, degrees.to_radians()), bounds.center());
    Pose {
        eye: center + turn * (pose.eye - center),
        world_from_view: (turn * pose.world_from_view).normalize(),
    }
}

/// The fields of the flags that change the look without its light, and those of the light.
const OF_LOOK: [&str; 7] = ["tf", "shading", "mode", "iso", "clip_box", "clip_plane", "k"];
const OF_LIGHT: [&str; 7] =
    ["ambient_occlusion", "occlusion_radius", "shadows", "softness", "light", "specular", "shininess"];
