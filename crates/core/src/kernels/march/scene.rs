//! A volume with a look, ready to be marched.

use std::sync::Arc;

use glam::Vec3;

use super::modes::{self, Surface};
use super::pages::ScenePages;
use super::{Lattice, MAX_STEPS, MarchSettings, surfaces};
use crate::channels::{Blend, Channels, Visibility};
use crate::clip::Region;
use crate::mode::Mode;
use crate::space::Ray;
use crate::transfer::{TransferFunction, TransferTable};
use crate::volume::{
    Bricks, Histogram, Illumination, Occlusion, Occupancy, Volume, opacity_table, opacity_volume,
};

/// A volume that is ready to be marched, with bricks and a tabulated transfer function.
///
/// A projection and surfaces show the chosen one of several channels, unless it has labels. Otherwise all
/// visible channels are marched together: the first of them is `volume`, and `others` follow.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The voxels.
    pub volume: Arc<Volume>,
    /// Their minima and maxima by brick.
    pub bricks: Arc<Bricks>,
    /// Their histogram.
    pub histogram: Arc<Histogram>,
    /// Classification; in a projection, the display colour of a value ([`TransferFunction::shown_table`]), and for the
    /// mean that times the [`exposure`](TransferFunction::exposure).
    pub table: TransferTable,
    /// Which channel `volume` is, from 0.
    pub first_channel: usize,
    /// The pages that are shown in place of `volume`, which is then the coarsest level of theirs.
    pub pages: Option<ScenePages>,
    /// The channels that are marched together with `volume`.
    pub others: Vec<MarchedChannel>,
    /// How their matter counts together.
    pub blend: Blend,
    /// The surfaces of [`Mode::Iso`], by ascending position.
    pub surfaces: Vec<Surface>,
    /// Whether surfaces enclose matter of lesser values.
    pub has_lesser_bodies: bool,
    /// Bricks that the mode leaves visible.
    pub occupancy: Occupancy,
    /// Brightness of the voxels, if `settings` ask for shading or lighting.
    pub illumination: Illumination,
    /// The settings of the march.
    pub settings: MarchSettings,
    /// What the first channel of the volume is classified by.
    pub transfer: Arc<TransferFunction>,
    /// All channels of the volume.
    pub channels: Arc<[ChannelFacts]>,
    /// What of the channels is shown.
    pub looks: Channels,
    /// Of mixed channels that are lit, the opacity of each voxel, which stands for them.
    pub opacities: Option<Arc<Volume>>,
}

/// A channel that is marched beside the first.
#[derive(Clone, Debug)]
pub struct MarchedChannel {
    /// The channel, from 0.
    pub channel: usize,
    /// The voxels.
    pub volume: Arc<Volume>,
    /// Their classification.
    pub table: TransferTable,
}

/// A channel of a volume, and what no look changes.
#[derive(Clone, Debug)]
pub struct ChannelFacts {
    /// The voxels.
    pub volume: Arc<Volume>,
    /// Their minima and maxima by brick.
    pub bricks: Arc<Bricks>,
    /// Their histogram.
    pub histogram: Arc<Histogram>,
}

impl ChannelFacts {
    fn of(volume: Arc<Volume>) -> Self {
        let (bricks, histogram) = (Arc::new(Bricks::of(&volume)), Arc::new(Histogram::of(&volume)));
        Self { volume, bricks, histogram }
    }

    fn table(&self, transfer: &TransferFunction, visibility: &Visibility) -> TransferTable {
        if self.volume.info.are_labels {
            transfer.label_table(&self.volume, &visibility.hidden_labels)
        } else {
            transfer.table(&self.volume, &self.histogram)
        }
    }
}

impl Scene {
    /// Prepares a volume, of which the first channel is shown. `transfer` must be valid.
    pub fn new(volume: Arc<Volume>, transfer: &TransferFunction, settings: MarchSettings) -> Self {
        Self::with_channels(volume, transfer, Channels::default(), settings)
    }

    /// Prepares a volume with looks of its channels. `transfer`, of the first, must be valid.
    pub fn with_channels(
        volume: Arc<Volume>,
        transfer: &TransferFunction,
        looks: Channels,
        settings: MarchSettings,
    ) -> Self {
        let others = volume.others().iter().cloned();
        let channels: Arc<[ChannelFacts]> =
            std::iter::once(volume.clone()).chain(others).map(ChannelFacts::of).collect();
        Self::build(channels, transfer, looks, settings, None)
    }

    /// The same volume with another transfer function and settings. Bricks, histogram and unchanged lighting are
    /// shared.
    pub fn with_look(&self, transfer: &TransferFunction, settings: MarchSettings) -> Self {
        self.with_look_near(transfer, settings, self.illumination.occlusion().as_ref())
    }

    /// The same, but a draft takes its ambient occlusion from `near`, or has none.
    pub fn with_look_near(
        &self,
        transfer: &TransferFunction,
        settings: MarchSettings,
        near: Option<&Occlusion>,
    ) -> Self {
        Self::build(self.channels.clone(), transfer, self.looks.clone(), settings, Some((self, near)))
    }

    /// Prepares channels, and takes from another scene of the same volume what stays.
    pub(crate) fn build(
        channels: Arc<[ChannelFacts]>,
        transfer: &TransferFunction,
        looks: Channels,
        settings: MarchSettings,
        before: Option<(&Self, Option<&Occlusion>)>,
    ) -> Self {
        // Labels are names, of which none is the greatest, the mean or passed by a surface.
        let chosen = usize::from(looks.chosen).min(channels.len() - 1);
        let are_labels = channels[chosen].volume.info.are_labels;
        let mode = if are_labels { Mode::Composite } else { settings.mode };
        let settings = MarchSettings { mode, ..settings };
        let transfer_of = |channel: usize| match channel.checked_sub(1) {
            None => transfer,
            Some(other) => looks.others.get(other).map_or(transfer, |look| &look.transfer),
        };
        let marched = marched(channels.len(), &looks, settings.mode);
        let first = marched.first().copied();
        let ChannelFacts { volume, bricks, histogram } = channels[first.unwrap_or(0)].clone();
        let shown = transfer_of(first.unwrap_or(0));
        let (mut table, surfaces) = if settings.mode == Mode::Composite {
            let nothing = Visibility::default();
            let visibility = looks.visibility(first.unwrap_or(0)).unwrap_or(&nothing);
            (channels[first.unwrap_or(0)].table(shown, visibility), Vec::new())
        } else {
            classify(&volume, &histogram, shown, &settings)
        };
        if first.is_none() {
            table = table.scaled(0.0);
        }
        let others = marched.iter().skip(1).filter_map(|&channel| {
            let facts = &channels[channel];
            let table = facts.table(transfer_of(channel), looks.visibility(channel)?);
            Some(MarchedChannel { channel, volume: facts.volume.clone(), table })
        });
        let others: Vec<MarchedChannel> = others.collect();
        // Dragging a clip or a light changes neither the visible bricks nor what is lit.
        let alike = before.map(|(scene, _)| scene).filter(|scene| {
            (scene.settings.mode, &scene.table, &scene.surfaces, scene.blend)
                == (settings.mode, &table, &surfaces, looks.blend)
                && Arc::ptr_eq(&scene.volume, &volume)
                && tables(&scene.others).eq(tables(&others))
        });
        let is_mixed = !others.is_empty() || table.are_labels;
        let occupancy = match alike {
            Some(alike) => alike.occupancy.clone(),
            None if is_mixed => {
                let rest = others.iter().map(|o| (&*channels[o.channel].bricks, &o.table));
                let all: Vec<_> = std::iter::once((&*bricks, &table)).chain(rest).collect();
                Bricks::occupancy_of_channels(&all)
            }
            None => modes::occupancy(&bricks, settings.mode, &table, &surfaces),
        };
        let is_lit = settings.shading.is_some() || settings.lighting.is_on();
        let opacities = match alike.and_then(|alike| alike.opacities.clone()) {
            Some(opacities) => Some(opacities),
            None if is_mixed && is_lit => {
                let rest = others.iter().map(|o| (&*o.volume, &o.table));
                let all: Vec<_> = std::iter::once((&*volume, &table)).chain(rest).collect();
                opacity_volume(&all, looks.blend).map(Arc::new)
            }
            None => None,
        };
        let has_lesser_bodies = surfaces::has_lesser(&surfaces, &table, &volume, &settings.clip);
        let lit_before = before.map(|(scene, near)| (&scene.illumination, near));
        let illumination = match &opacities {
            Some(opacities) => {
                modes::illuminate(opacities, &opacity_table(opacities), &[], settings, lit_before)
            }
            None => modes::illuminate(&volume, &table, &surfaces, settings, lit_before),
        };
        let blend = looks.blend;
        let mut scene = Self {
            volume,
            bricks,
            histogram,
            table,
            others,
            blend,
            surfaces,
            has_lesser_bodies,
            occupancy,
            illumination,
            settings,
            transfer: Arc::new(transfer.clone()),
            channels,
            looks,
            opacities,
            first_channel: first.unwrap_or(0),
            pages: None,
        };
        if let Some((before, set)) = before.and_then(|(b, _)| Some((b, b.pages.as_ref()?.set.clone()))) {
            scene.pages = Some(scene.look_at(set, Some(before)));
        }
        scene
    }

    /// Distances of the voxels that a march steps by, world units, and the world's origin in their voxel space.
    pub fn voxel_space(&self) -> (Vec3, Vec3) {
        let Some(pages) = &self.pages else { return (self.volume.spacing(), self.volume.voxel_origin()) };
        let pyramid = pages.set.pyramid();
        (pyramid.spacing, Vec3::from_array(pyramid.dims().map(|n| n as f32 * 0.5)))
    }

    /// The volumes that are marched together, in their order.
    pub fn marched_volumes(&self) -> impl Iterator<Item = &Volume> {
        std::iter::once(&*self.volume).chain(self.others.iter().map(|other| &*other.volume))
    }

    /// Whether the brightness is that of the look, in its final detail.
    pub fn is_final(&self) -> bool {
        let lit = self.illumination.lit();
        self.illumination.is_final() && self.pages.as_ref().is_none_or(|pages| pages.are_lit_for(lit))
    }

    /// Whether the march mixes channels, or reads labels.
    pub fn is_mixed(&self) -> bool {
        self.settings.mode == Mode::Composite && (!self.others.is_empty() || self.table.are_labels)
    }

    /// The whole volume, whose first channel this is. `volume` is the channel that is marched first.
    pub fn whole(&self) -> &Arc<Volume> {
        &self.channels[0].volume
    }

    /// The histograms of all channels, in their order.
    pub fn histograms(&self) -> impl Iterator<Item = &Histogram> {
        self.channels.iter().map(|channel| &*channel.histogram)
    }

    /// The visible part of the volume.
    pub fn region(&self) -> Region {
        self.settings.clip.region(&self.volume.bounds())
    }

    /// Number of steps on the longest ray.
    pub fn max_steps(&self) -> u32 {
        let dims = match &self.pages {
            Some(pages) => Vec3::from_array(pages.set.pyramid().dims().map(|n| n as f32)),
            None => Vec3::from_array(self.volume.whole_dims().map(|n| n as f32)),
        };
        (dims.length() / self.settings.step_in_voxels).ceil().clamp(1.0, MAX_STEPS) as u32
    }

    /// The lattice of steps of a ray inside the visible part, in front of the camera's near plane.
    pub fn lattice(&self, ray: &Ray, near: f32) -> Option<Lattice> {
        let (s0, s1) = self.region().clip(ray)?;
        let s0 = s0.max(near);
        if s1 <= s0 {
            return None;
        }
        // Steps are longer along longer sides of voxels: no ray takes more of them between two voxels than along the
        // shortest side.
        let (spacing, _) = self.voxel_space();
        let voxel_from_world = spacing.recip();
        let voxels = (ray.dir * voxel_from_world).length();
        let share = (voxels / voxel_from_world.max_element()).min(1.0);
        let step_in_world = self.settings.step_in_voxels * spacing.min_element();
        let n = ((s1 - s0) / step_in_world * share).ceil().clamp(1.0, MAX_STEPS);
        let h = (s1 - s0) / n;
        Some(Lattice { s0, h, first: 0, n: n as u32, unit: h * share })
    }
}

/// The channels of media with their tables.
fn tables(media: &[MarchedChannel]) -> impl Iterator<Item = (usize, &TransferTable)> {
    media.iter().map(|medium| (medium.channel, &medium.table))
}

/// The channels that are marched together, ascending.
fn marched(num_channels: usize, looks: &Channels, mode: Mode) -> Vec<usize> {
    if mode != Mode::Composite {
        return vec![usize::from(looks.chosen).min(num_channels - 1)];
    }
    let is_shown = |channel: &usize| looks.visibility(*channel).is_some_and(|v| !v.is_hidden);
    (0..num_channels).filter(is_shown).collect()
}

/// The table and the surfaces of a mode.
fn classify(
    volume: &Volume,
    histogram: &Histogram,
    transfer: &TransferFunction,
    settings: &MarchSettings,
) -> (TransferTable, Vec<Surface>) {
    if settings.mode.is_projection() {
        let table = transfer.shown_table(volume, histogram);
        let exposure = if settings.mode == Mode::Average { transfer.exposure(volume, &table) } else { 1.0 };
        return (table.scaled(exposure), Vec::new());
    }
    let table = transfer.table(volume, histogram);
    let surfaces = modes::surfaces(transfer, &table, volume, histogram, &settings.isos);
    (table, surfaces)
}
