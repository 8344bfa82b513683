//! Pictures of a volume whose parts are in several processes: each sees the rays in its own part, and one process puts
//! the parts of each ray together.

use std::ops::Range;

use rayon::prelude::*;

use super::lens::View;
use super::march::{Lattice, Marcher, Scene, TRANSMITTANCE_MIN, Texels, with_texels};
use super::part_rays::own_steps;
use super::part_rows::{self, PartsError};
use crate::picture::Picture;
use crate::space::Ray;
use crate::volume::Split;

/// What a process sees of some rows of a view in its own part of the volume, as words.
pub fn seen(scene: &Scene, split: &Split, rank: usize, view: &View, rows: Range<u32>) -> Vec<u32> {
    with_texels!(scene, texels => seen_with(&Marcher::new(scene, texels), scene, split, rank, view, rows))
}

/// A pixel's ray with its lattice in the whole volume.
fn ray_of(scene: &Scene, view: &View, x: u32, y: u32) -> Option<(Ray, Lattice)> {
    let (ray, s_per_depth) = view.basis.ray(x as f32 + 0.5, y as f32 + 0.5);
    Some((ray, scene.lattice(&ray, view.near * s_per_depth)?))
}

fn seen_with<T: Texels>(
    marcher: &Marcher<'_, T>,
    scene: &Scene,
    split: &Split,
    rank: usize,
    view: &View,
    rows: Range<u32>,
) -> Vec<u32> {
    let rows: Vec<u32> = rows.collect();
    part_rows::write(&rows, view.basis.width as u32, |x, y, words| {
        let Some((ray, lattice)) = ray_of(scene, view, x, y) else { return 0 };
        let Some(part) = own_steps(marcher, (split, rank), &ray, lattice) else { return 0 };
        words.extend(marcher.seen_in(&ray, part, TRANSMITTANCE_MIN).map(f32::to_bits));
        1
    })
}

/// Some rows of the picture of a view, premultiplied linear; `lists` are the words of each process.
///
/// # Errors
/// If one did not send what a process sees of these rows.
pub fn picture_of_parts(
    scene: &Scene,
    split: &Split,
    view: &View,
    rows: Range<u32>,
    lists: &[Vec<u32>],
) -> Result<Picture, PartsError> {
    with_texels!(scene, texels => unite_with(&Marcher::new(scene, texels), scene, split, view, rows, lists))
}

fn unite_with<T: Texels>(
    marcher: &Marcher<'_, T>,
    scene: &Scene,
    split: &Split,
    view: &View,
    rows: Range<u32>,
    lists: &[Vec<u32>],
) -> Result<Picture, PartsError> {
    let (width, height) = (view.basis.width as u32, rows.len() as u32);
    let found = part_rows::read_all(lists, split.boxes().len(), rows.len(), width, WORDS)?;
    let mut picture = Picture::new(width, height);
    picture.pixels.par_chunks_mut(width.max(1) as usize).enumerate().for_each(|(y, row)| {
        let mut columns: Vec<_> = found.iter().map(|rows| rows[y].columns()).collect();
        for (x, pixel) in row.iter_mut().enumerate() {
            let here: Vec<&[u32]> = columns.iter_mut().map(|columns| columns(x as u32)).collect();
            let Some((ray, lattice)) = ray_of(scene, view, x as u32, rows.start + y as u32) else { continue };
            let mut parts = Vec::new();
            split.runs(&marcher.point_line(&ray, lattice), 0..lattice.n, &mut |of, _| {
                let words = here[of].as_chunks::<WORDS>().0;
                parts.extend(words.iter().map(|words| words.map(f32::from_bits)));
            });
            *pixel = scene.seen_of_parts(lattice, parts.into_iter());
        }
    });
    Ok(picture)
}

/// Words of what is seen along a ray.
pub(super) const WORDS: usize = 4;
