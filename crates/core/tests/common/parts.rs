//! A volume in parts, each in a scene of its own, and frames of all of them.

use std::sync::Arc;

use isinglass_core::kernels::layering::parts::{
    AskedFrame, frame_from_words, frame_of_rows, pieces, steps, threshold, unite, words_from_rows,
};
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::kernels::rows_of;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::{Split, Volume};

pub(crate) struct Parts {
    pub(crate) split: Split,
    pub(crate) scenes: Vec<Scene>,
}

impl Parts {
    /// Scenes of the parts, with so many voxels around each.
    pub(crate) fn of(
        volume: &Volume,
        split: Split,
        transfer: &TransferFunction,
        settings: MarchSettings,
        ghosts: u32,
    ) -> Self {
        let scene = |rank| {
            let part = volume.part(&split.held(rank, ghosts)).expect("a part lies inside");
            Scene::new(Arc::new(part), transfer, settings)
        };
        let scenes: Vec<Scene> = (0..split.boxes().len()).map(scene).collect();
        let areas = scenes.iter().zip(split.boxes()).filter_map(|(scene, own)| scene.areas_of_bodies(own));
        let sum = areas.reduce(|a, b| [a[0] + b[0], a[1]]);
        let scenes = match sum {
            Some(areas) => scenes.into_iter().map(|scene| scene.with_areas_of_bodies(areas)).collect(),
            None => scenes,
        };
        Self { split, scenes }
    }

    /// The frame asked for, at the threshold of the counted rays.
    pub(crate) fn asked(&self, header: FrameHeader) -> AskedFrame {
        let mut frame = AskedFrame::new(&self.scenes[0], header, 0.0);
        let each = self.scenes.iter().enumerate();
        let lists: Vec<_> = each.map(|(rank, scene)| steps(scene, &self.split, rank, &frame)).collect();
        frame.threshold =
            threshold(&self.scenes[0], &self.split, &frame, &lists).expect("all steps are there");
        frame
    }

    /// What each part sends the owner of some rows.
    pub(crate) fn pieces(&self, frame: &AskedFrame, rows: &[u32]) -> Vec<Vec<u32>> {
        let each = self.scenes.iter().enumerate();
        each.map(|(rank, scene)| pieces(scene, &self.split, rank, frame, rows)).collect()
    }

    /// The frame of all parts.
    pub(crate) fn frame(&self, header: FrameHeader) -> LayeredFrame {
        let frame = self.asked(header);
        let (num, height) = (self.scenes.len(), header.camera.intrinsics.height);
        let rows: Vec<_> = (0..num).map(|owner| rows_of(owner, num, height)).collect();
        let of_owner = |(owner, rows): (usize, &Vec<u32>)| {
            let lists = self.pieces(&frame, rows);
            let made = unite(&self.scenes[owner], &self.split, &frame, rows, &lists);
            frame_of_rows(&frame, rows, made.expect("pieces of all parts"))
        };
        let of_owners: Vec<_> = rows.iter().enumerate().map(of_owner).collect();
        let words: Vec<_> = of_owners.iter().zip(&rows).map(|(of, rows)| words_from_rows(of, rows)).collect();
        let made = frame_from_words(of_owners[0].header, &rows, &words).expect("rows of all owners");
        made.validate().expect("a frame keeps its promises");
        made
    }
}
