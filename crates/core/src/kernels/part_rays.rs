//! The rays that meet a process's own part of a volume, for a device that gathers along them.
//!
//! The steps of each ray are found here and nowhere else. A device has other roundings, and two processes must not
//! disagree about who marches a step.

use rayon::prelude::*;

use super::lens::View;
use super::march::{Lattice, Marcher, Scene, Texels, with_texels};
use super::part_rows::{self, MAX_ITEMS};
use crate::space::Ray;
use crate::volume::Split;

/// A process's own part of a volume that is cut into parts.
#[derive(Clone, Copy)]
pub struct MarchedPart<'a> {
    /// Shows the own part under the wanted look.
    pub scene: &'a Scene,
    /// The boxes of all processes.
    pub split: &'a Split,
    /// The number of this process.
    pub rank: usize,
}

/// A ray that meets the part.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PartRay {
    /// Column and row of its pixel.
    pub pixel: [u16; 2],
    /// Its steps in the part.
    pub lattice: Lattice,
}

/// The rays of some pixels that meet the part, in tiles of neighbours.
pub struct PartRays {
    rays: Vec<PartRay>,
    num_columns: usize,
    rows: Vec<u32>,
    /// For each pixel, row by row, its place in `rays`, or [`NO_RAY`].
    places: Vec<u32>,
}

/// What was gathered along rays, in words of 32 bits.
#[derive(Clone, Debug, Default)]
pub struct RayItems {
    /// For each ray the first word of its items, and their number.
    pub spans: Vec<[u32; 2]>,
    /// The items.
    pub words: Vec<u32>,
    /// Words of an item.
    pub words_per_item: usize,
}

impl RayItems {
    fn of_ray(&self, ray: usize) -> &[u32] {
        let [first, num] = self.spans.get(ray).map_or([0; 2], |span| span.map(|n| n as usize));
        self.words.get(first..first + num * self.words_per_item).unwrap_or(&[])
    }
}

/// The steps of a ray in a process's box, given all of its steps.
pub(super) fn own_steps<T: Texels>(
    marcher: &Marcher<'_, T>,
    (split, rank): (&Split, usize),
    ray: &Ray,
    whole: Lattice,
) -> Option<Lattice> {
    let mut own = None;
    split.runs(&marcher.point_line(ray, whole), 0..whole.n, &mut |of, steps| {
        if of == rank {
            own = Some(Lattice { first: steps.start, n: steps.end, ..whole });
        }
    });
    own
}

impl PartRays {
    /// The rays of a view through the pixels of these columns and rows, both below 2¹⁶.
    pub fn of(part: &MarchedPart<'_>, view: &View, columns: &[u32], rows: &[u32]) -> Self {
        let &MarchedPart { scene, split, rank } = part;
        with_texels!(scene, texels => {
            let marcher = Marcher::new(scene, texels);
            Self::found_by(columns, rows, |x, y| {
                let (ray, s_per_depth) = view.basis.ray(x as f32 + 0.5, y as f32 + 0.5);
                let whole = scene.lattice(&ray, view.near * s_per_depth)?;
                let lattice = own_steps(&marcher, (split, rank), &ray, whole)?;
                Some(PartRay { pixel: [x as u16, y as u16], lattice })
            })
        })
    }

    fn found_by(columns: &[u32], rows: &[u32], find: impl Fn(u32, u32) -> Option<PartRay> + Sync) -> Self {
        let num_columns = columns.len();
        let of_rows = |rows: &[u32]| {
            let (mut rays, mut places) = (Vec::new(), vec![NO_RAY; num_columns * rows.len()]);
            for first in (0..num_columns).step_by(TILE[0]) {
                let tile = &columns[first..num_columns.min(first + TILE[0])];
                for (row, &y) in rows.iter().enumerate() {
                    for (column, &x) in (first..).zip(tile) {
                        if let Some(ray) = find(x, y) {
                            places[row * num_columns + column] = rays.len() as u32;
                            rays.push(ray);
                        }
                    }
                }
            }
            (rays, places)
        };
        let found: Vec<_> = rows.par_chunks(TILE[1]).map(of_rows).collect();
        let mut all = Self { rays: Vec::new(), num_columns, rows: rows.to_vec(), places: Vec::new() };
        for (rays, places) in found {
            let before = all.rays.len() as u32;
            all.places
                .extend(places.iter().map(|&place| if place == NO_RAY { place } else { before + place }));
            all.rays.extend(rays);
        }
        all
    }

    /// The rays.
    pub fn rays(&self) -> &[PartRay] {
        &self.rays
    }

    /// The words about all rows for one process, given what was gathered along the rays.
    pub fn words(&self, items: &RayItems) -> Vec<u32> {
        self.words_of_rows(0, self.rows.len(), items)
    }

    /// The same for `num` rows from the one at place `first` on.
    pub fn words_of_rows(&self, first: usize, num: usize, items: &RayItems) -> Vec<u32> {
        let places: Vec<u32> = (first as u32..(first + num) as u32).collect();
        part_rows::write(&places, self.num_columns as u32, |column, row, words| {
            let place = self.places[row as usize * self.num_columns + column as usize];
            let found = if place == NO_RAY { &[] } else { items.of_ray(place as usize) };
            let most = found.len().min(MAX_ITEMS * items.words_per_item);
            words.extend_from_slice(&found[..most]);
            most / items.words_per_item.max(1)
        })
    }
}

/// The pixel's ray misses the part.
const NO_RAY: u32 = u32::MAX;
/// Columns and rows of neighbours whose rays follow each other: they read the same voxels.
const TILE: [usize; 2] = [8, 4];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_come_in_tiles_and_words_in_rows() {
        let lattice = Lattice { s0: 0.0, h: 1.0, first: 0, n: 1, unit: 1.0 };
        let (columns, rows) = ((0..19).collect::<Vec<u32>>(), [3, 4, 5, 8, 9]);
        let meets = |x: u32, y: u32| !(x + y).is_multiple_of(3);
        let found = PartRays::found_by(&columns, &rows, |x, y| {
            meets(x, y).then_some(PartRay { pixel: [x as u16, y as u16], lattice })
        });
        // Rays of the second tile follow those of all four rows of the first.
        let of_first = found.rays().iter().take_while(|ray| ray.pixel[0] < 8).count();
        assert_eq!(of_first, rows[..4].iter().map(|y| (0..8).filter(|x| meets(*x, *y)).count()).sum());
        // A ray's number of items is its column modulo 4, and each is the pixel, twice.
        let mut items = RayItems { words_per_item: 2, ..RayItems::default() };
        for ray in found.rays() {
            let [x, y] = ray.pixel.map(u32::from);
            items.spans.push([items.words.len() as u32, x % 4]);
            items.words.extend(vec![x * 100 + y; 2 * (x as usize % 4)]);
        }
        let expected = |rows: &[u32]| {
            part_rows::write(rows, 19, |x, y, words| {
                let num = if meets(x, y) { x as usize % 4 } else { 0 };
                words.extend(vec![x * 100 + y; 2 * num]);
                num
            })
        };
        assert_eq!(found.words(&items), expected(&rows));
        assert_eq!(found.words_of_rows(1, 2, &items), expected(&[4, 5]));
        // The control.
        assert_ne!(found.words_of_rows(1, 2, &items), expected(&[5, 8]));
    }
}
