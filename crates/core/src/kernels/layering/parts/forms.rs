//! What a part of a ray is sent as, for each mode: pieces, crossings or steps, in words of 32 bits.

use glam::Vec3;

use super::super::projection::{ProjectionLister, ProjectionPiece, RayConstants};
use super::super::stream::PieceStream;
use super::super::visibility_merge::{Lister, MatterPiece, StepsPerLength, even_moments};
use super::super::{Listing, SegmentList};
use super::LONGEST;
use crate::kernels::march::{Advance, Lattice, Sink, Step, Texels};
use crate::kernels::raycast::opacity;
use crate::layer::{COLOR_MAX, pack_halves, unpack_halves};
use crate::mode::Mode;

/// How a ray's way through a part is sent.
pub(super) trait Form {
    /// Words of an item.
    const WORDS: usize;

    /// Adds the items of a ray whose lattice is that of the part; `whole` is that of the whole ray.
    fn gather<T: Texels>(of: &Listing<'_, T>, whole: &Lattice, threshold: f32, words: &mut Vec<u32>);

    /// Fills the empty `list` of a ray. `each` hands on the words of the parts from front to back.
    fn list<T: Texels>(
        of: &Listing<'_, T>,
        longest: usize,
        threshold: f32,
        each: impl FnOnce(&mut dyn FnMut(&[u32])),
        list: &mut SegmentList,
    );
}

/// The lattice of a part as one of its own, for what a list has room for.
fn alone(part: &Lattice) -> Lattice {
    Lattice { s0: part.s0 + part.first as f32 * part.h, first: 0, n: (part.n - part.first).max(1), ..*part }
}

/// Pieces of matter: both ends, optical depth and colour, and how far opacity and colour are displaced.
pub(super) struct MatterForm;

struct MatterParts<'a> {
    ray: StepsPerLength,
    stream: PieceStream<MatterPiece>,
    transmittance: f32,
    words: &'a mut Vec<u32>,
}

impl Sink for MatterParts<'_> {
    #[inline(always)]
    fn step(&mut self, step: Step) -> Advance {
        let Self { ray, stream, transmittance, words } = self;
        let matter = MatterPiece::of(&step, *transmittance, ray);
        stream.step(ray, matter, step.s0, |matter| words.extend(words_of_matter(matter, ray)));
        *transmittance *= 1.0 - step.alpha;
        Advance::behind(*transmittance)
    }
}

impl Form for MatterForm {
    const WORDS: usize = 7;

    fn gather<T: Texels>(of: &Listing<'_, T>, _: &Lattice, threshold: f32, words: &mut Vec<u32>) {
        let stream = PieceStream::new(threshold, LONGEST, &alone(&of.lattice));
        let ray = StepsPerLength(1.0 / of.lattice.unit);
        let mut parts = MatterParts { ray, stream, transmittance: 1.0, words };
        of.march(&mut parts);
        let MatterParts { ray, mut stream, words, .. } = parts;
        stream.finish(&ray, |matter| words.extend(words_of_matter(matter, &ray)));
    }

    fn list<T: Texels>(
        of: &Listing<'_, T>,
        longest: usize,
        threshold: f32,
        each: impl FnOnce(&mut dyn FnMut(&[u32])),
        list: &mut SegmentList,
    ) {
        let ray = StepsPerLength(1.0 / of.lattice.unit);
        let mut lister = Lister::new(threshold, longest, &of.lattice, list);
        each(&mut |words| {
            for words in words.as_chunks().0 {
                lister.take(matter_from_words(words, &ray));
            }
        });
        lister.finish();
    }
}

/// Colours are sent as those of opaque matter, so that thin matter keeps its precision. Displacements are against a
/// homogeneous medium, as shares of the length.
fn words_of_matter(matter: &MatterPiece, ray: &StepsPerLength) -> [u32; MatterForm::WORDS] {
    let Step { s0, s1, c, tau, alpha } = matter.all;
    let color = c / alpha.max(ALPHA_LEAST);
    let length = ((s1 - s0) * ray.0).max(LENGTH_LEAST);
    let (even_first, even_second) = even_moments(tau, alpha);
    let per_moment = 1.0 / (length * alpha).max(ALPHA_LEAST);
    let first = matter.first * per_moment - even_first / alpha.max(ALPHA_LEAST);
    let second = matter.second * per_moment / length - even_second / alpha.max(ALPHA_LEAST);
    let moved = (matter.color_first * per_moment - color * (even_first / alpha.max(ALPHA_LEAST))) / COLOR_MAX;
    let signed = |lo: f32, hi: f32| u32::from(code(lo)) | u32::from(code(hi)) << 16;
    [
        s0.to_bits(),
        s1.to_bits(),
        tau.to_bits(),
        pack_halves(color.x, color.y),
        pack_halves(color.z, 0.0) | u32::from(code(first)) << 16,
        signed(second, moved.x),
        signed(moved.y, moved.z),
    ]
}

fn matter_from_words(words: &[u32; MatterForm::WORDS], ray: &StepsPerLength) -> MatterPiece {
    let [s0, s1, tau] = [0, 1, 2].map(|i| f32::from_bits(words[i]));
    let alpha = opacity(tau);
    let (r, g) = unpack_halves(words[3]);
    let (b, _) = unpack_halves(words[4] & 0xffff);
    let color = Vec3::new(r, g, b);
    let length = ((s1 - s0) * ray.0).max(LENGTH_LEAST);
    let (even_first, even_second) = even_moments(tau, alpha);
    let first = number(words[4] >> 16);
    let (second, x) = (number(words[5]), number(words[5] >> 16));
    let moved = Vec3::new(x, number(words[6]), number(words[6] >> 16)) * COLOR_MAX;
    let step = Step { s0, s1, c: color * alpha, tau, alpha };
    let mut matter = MatterPiece::of(&step, 1.0, ray);
    matter.first = (even_first + first * alpha) * length;
    matter.second = (even_second + second * alpha) * (length * length);
    matter.color_first = (color * even_first + moved * alpha) * length;
    matter
}

/// A number from −1 to 1 in 16 bits.
fn code(x: f32) -> u16 {
    (x.clamp(-1.0, 1.0) * CODES).round() as i16 as u16
}

fn number(code: u32) -> f32 {
    f32::from(code as u16 as i16) * (1.0 / CODES)
}

/// Crossings of surfaces: their place, optical depth and colour, and whether values rise.
pub(super) struct CrossingForm;

struct Crossings<'a>(&'a mut Vec<u32>);

impl Sink for Crossings<'_> {
    fn step(&mut self, step: Step) -> Advance {
        let rises = u32::from(step.s1 > step.s0);
        let blue = pack_halves(step.c.z, 0.0) | rises << 16;
        self.0.extend([step.s0.to_bits(), step.tau.to_bits(), pack_halves(step.c.x, step.c.y), blue]);
        // Every point counts: no integral reveals a sheet that a stride steps over.
        Advance::Step
    }
}

impl Form for CrossingForm {
    const WORDS: usize = 4;

    fn gather<T: Texels>(of: &Listing<'_, T>, _: &Lattice, _: f32, words: &mut Vec<u32>) {
        of.marcher.crossings(&of.ray, of.lattice, &mut Crossings(words));
    }

    fn list<T: Texels>(
        of: &Listing<'_, T>,
        longest: usize,
        threshold: f32,
        each: impl FnOnce(&mut dyn FnMut(&[u32])),
        list: &mut SegmentList,
    ) {
        let mut lister = Lister::new(threshold, longest, &of.lattice, list);
        let mut thicken = of.marcher.thicken(of.lattice, &mut lister);
        each(&mut |words| {
            for &[s0, tau, rg, b] in words.as_chunks().0 {
                let (s0, tau) = (f32::from_bits(s0), f32::from_bits(tau));
                let ((x, y), (z, _)) = (unpack_halves(rg), unpack_halves(b & 0xffff));
                let s1 = if b >> 16 == 1 { f32::INFINITY } else { f32::NEG_INFINITY };
                thicken.step(Step { s0, s1, c: Vec3::new(x, y, z), tau, alpha: opacity(tau) });
            }
        });
        thicken.finish();
        lister.finish();
    }
}

/// Pieces of a projection of the greatest or the least value.
pub(super) struct GreatestForm;
/// Pieces of a mean.
pub(super) struct MeanForm;

struct ProjectionParts<'a> {
    ray: RayConstants,
    stream: PieceStream<ProjectionPiece>,
    words: &'a mut Vec<u32>,
    write: fn(&ProjectionPiece, &mut Vec<u32>),
}

impl Sink for ProjectionParts<'_> {
    fn step(&mut self, step: Step) -> Advance {
        let Self { ray, stream, words, write } = self;
        stream.step(ray, ProjectionPiece::of(&step, ray), step.s0, |piece| write(piece, words));
        Advance::Step
    }
}

fn gather_projection<T: Texels>(
    of: &Listing<'_, T>,
    whole: &Lattice,
    threshold: f32,
    words: &mut Vec<u32>,
    write: fn(&ProjectionPiece, &mut Vec<u32>),
) {
    let stream = PieceStream::new(threshold, LONGEST, &alone(&of.lattice));
    // Distances are from the start of the whole ray.
    let ray = RayConstants::of(of, *whole);
    let mut parts = ProjectionParts { ray, stream, words, write };
    of.marcher.project(&of.ray, of.lattice, &mut parts);
    let ProjectionParts { ray, mut stream, words, .. } = parts;
    stream.finish(&ray, |piece| write(piece, words));
}

fn list_projection<T: Texels, const N: usize>(
    of: &Listing<'_, T>,
    longest: usize,
    threshold: f32,
    each: impl FnOnce(&mut dyn FnMut(&[u32])),
    list: &mut SegmentList,
    read: fn([f32; N]) -> ProjectionPiece,
) {
    let mut lister = ProjectionLister::new(of, [threshold], longest, list);
    each(&mut |words| {
        for words in words.as_chunks().0 {
            lister.take(read(words.map(f32::from_bits)));
        }
    });
    lister.finish();
}

impl Form for GreatestForm {
    const WORDS: usize = 5;

    fn gather<T: Texels>(of: &Listing<'_, T>, whole: &Lattice, threshold: f32, words: &mut Vec<u32>) {
        gather_projection(of, whole, threshold, words, |piece, words| {
            let &ProjectionPiece { s0, s1, peak, first, second, .. } = piece;
            words.extend([s0, s1, peak, first, second].map(f32::to_bits));
        });
    }

    fn list<T: Texels>(
        of: &Listing<'_, T>,
        longest: usize,
        threshold: f32,
        each: impl FnOnce(&mut dyn FnMut(&[u32])),
        list: &mut SegmentList,
    ) {
        list_projection(of, longest, threshold, each, list, |[s0, s1, peak, first, second]| {
            ProjectionPiece { s0, s1, peak, first, second, ..ProjectionPiece::default() }
        });
    }
}

impl Form for MeanForm {
    const WORDS: usize = 8;

    fn gather<T: Texels>(of: &Listing<'_, T>, whole: &Lattice, threshold: f32, words: &mut Vec<u32>) {
        gather_projection(of, whole, threshold, words, |piece, words| {
            let &ProjectionPiece { s0, s1, first, second, third, shown, .. } = piece;
            words.extend([s0, s1, first, second, third, shown.x, shown.y, shown.z].map(f32::to_bits));
        });
    }

    fn list<T: Texels>(
        of: &Listing<'_, T>,
        longest: usize,
        threshold: f32,
        each: impl FnOnce(&mut dyn FnMut(&[u32])),
        list: &mut SegmentList,
    ) {
        list_projection(of, longest, threshold, each, list, |[s0, s1, first, second, third, x, y, z]| {
            ProjectionPiece {
                s0,
                s1,
                first,
                second,
                third,
                shown: Vec3::new(x, y, z),
                ..ProjectionPiece::default()
            }
        });
    }
}

/// Steps and crossings as the march finds them.
pub(super) struct RawStep;

struct RawSteps<'a> {
    words: &'a mut Vec<u32>,
    /// Of matter; others are not hidden.
    transmittance: Option<f32>,
}

impl Sink for RawSteps<'_> {
    fn step(&mut self, step: Step) -> Advance {
        let Step { s0, s1, c, tau, alpha } = step;
        self.words.extend([s0, s1, c.x, c.y, c.z, tau, alpha].map(f32::to_bits));
        let Some(transmittance) = &mut self.transmittance else { return Advance::Step };
        *transmittance *= 1.0 - alpha;
        Advance::behind(*transmittance)
    }
}

impl RawStep {
    /// Words of a step.
    pub(super) const WORDS: usize = 7;

    /// The steps of some words.
    pub(super) fn steps(words: &[u32]) -> impl Iterator<Item = Step> {
        words.as_chunks::<{ Self::WORDS }>().0.iter().map(|words| {
            let [s0, s1, x, y, z, tau, alpha] = words.map(f32::from_bits);
            Step { s0, s1, c: Vec3::new(x, y, z), tau, alpha }
        })
    }

    /// Adds the steps of a ray whose lattice is that of the part.
    pub(super) fn gather<T: Texels>(of: &Listing<'_, T>, words: &mut Vec<u32>) {
        let mode = of.scene.settings.mode;
        let transmittance = (mode == Mode::Composite).then_some(1.0);
        let mut sink = RawSteps { words, transmittance };
        match mode {
            Mode::Composite => of.march(&mut sink),
            Mode::Iso => of.marcher.crossings(&of.ray, of.lattice, &mut sink),
            Mode::Mip | Mode::MinIp | Mode::Average => of.marcher.project(&of.ray, of.lattice, &mut sink),
        }
    }
}

/// Least number that is divided by.
const ALPHA_LEAST: f32 = 1e-30;
const LENGTH_LEAST: f32 = 1e-30;
/// Codes of positive numbers.
const CODES: f32 = 32767.0;
