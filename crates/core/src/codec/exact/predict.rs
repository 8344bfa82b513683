//! Predicts a segment from the lists to the left and above and from the segments in front of it. The context of its
//! numbers says how certain the prediction is. Encoder and decoder both run this, so it uses exact arithmetic only:
//! integers, tables made of sums and products (`scale`), and one product of IEEE floats, the transmittance in front.
//!
//! Surfaces continue from list to list, but the numbers of segments do not. So a segment is compared with the
//! neighbours' segments at its own depth, not with those of its own number. Colour is C = E·α, and on the square-root
//! scale its code is proportional to √α. So the optical depth is predicted from the thickness and the neighbours'
//! extinction, green from the optical depth, and red and blue from the ratio of green to its prediction.

use std::hint::{cold_path, select_unpredictable};

use super::contexts::{NUM_PLANES, PlaneCoder};
use super::rows::{ColorRatio, ListRows, Neighbors, SegmentCodes};
use super::scale::{self, MAX_COLOR_CODE, Scale};

/// A segment that is empty or begins in front of the previous one's back: its front, its back, and the previous back.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Misordered(pub(super) [u32; 3]);

/// Codes the segments of a row of lists with lengths `counts`. A decoder fills them in.
pub(super) fn row<P: PlaneCoder>(
    planes: &mut [P; NUM_PLANES],
    scale: &Scale,
    rows: &mut ListRows,
    counts: &[u8],
) -> Result<(), Misordered> {
    #[cfg(target_arch = "x86_64")]
    if has_wide_instructions() {
        #[expect(unsafe_code, reason = "the one way to instructions that not every processor has")]
        // SAFETY: this processor has these instructions.
        return unsafe { row_wide(planes, scale, rows, counts) };
    }
    passes(planes, scale, rows, counts)
}

#[cfg(target_arch = "x86_64")]
fn has_wide_instructions() -> bool {
    is_x86_feature_detected!("avx2")
        && is_x86_feature_detected!("bmi1")
        && is_x86_feature_detected!("bmi2")
        && is_x86_feature_detected!("lzcnt")
}

/// The same, compiled with instructions for shifts and leading zeros. No multiplication is fused with an addition.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,bmi1,bmi2,lzcnt")]
fn row_wide<P: PlaneCoder>(
    planes: &mut [P; NUM_PLANES],
    scale: &Scale,
    rows: &mut ListRows,
    counts: &[u8],
) -> Result<(), Misordered> {
    passes(planes, scale, rows, counts)
}

/// Codes one plane after the other where possible. Segments of a plane hardly depend on each other, so a processor
/// works on several at once. The planes of one segment each wait for the previous one.
#[inline(always)]
fn passes<P: PlaneCoder>(
    planes: &mut [P; NUM_PLANES],
    scale: &Scale,
    rows: &mut ListRows,
    counts: &[u8],
) -> Result<(), Misordered> {
    let [_, front, back, tau, green, red, blue] = planes;
    depths([front, back], rows, counts)?;
    optical_depths(tau, scale, rows);
    greens(green, scale, rows);
    reds_and_blues([red, blue], rows);
    Ok(())
}

/// The context of a list's length, given those to the left and above.
pub(super) fn length_context(left: u8, above: u8) -> usize {
    usize::from((u16::from(left) + u16::from(above)).div_ceil(2).min(11)) * 3
        + usize::from(left.abs_diff(above).min(2))
}

/// Codes fronts and backs of the segments, and notes which neighbours each one is like.
#[inline(always)]
fn depths<P: PlaneCoder>(
    [fronts, backs]: [&mut P; 2],
    rows: &mut ListRows,
    counts: &[u8],
) -> Result<(), Misordered> {
    let ListRows { depths, links, above, own, .. } = rows;
    let (depths, mut links) = (&mut depths[..], &mut links[..]);
    let mut left = 0;
    for ((&count, &above), &own) in counts.iter().zip(&*above).zip(&*own) {
        if count > 0 {
            let links = links.split_off_mut(..usize::from(count)).unwrap_or_default();
            list([fronts, backs], depths, [left, above as usize], own as usize, links)?;
        }
        left = own as usize;
    }
    Ok(())
}

#[inline(always)]
fn list<P: PlaneCoder>(
    [fronts, backs]: [&mut P; 2],
    depths: &mut [u32],
    [mut left, mut above]: [usize; 2],
    own: usize,
    links: &mut [Neighbors],
) -> Result<(), Misordered> {
    let mut last_back = 0;
    let last = links.len() - 1;
    for (number, link) in links.iter_mut().enumerate() {
        if last_back == NONE {
            return Err(Misordered([last_back; 3]));
        }
        let slot = own + number;
        let given = depths[slot];
        let is_first = number == 0;
        left = pass(depths, left, last_back);
        above = pass(depths, above, last_back);
        let ahead = Ahead::new(depths, left, above, last_back);
        let coded = fronts.code::<true>(ahead.context(is_first), || match front_of(given) == last_back {
            true => 0,
            false => 1 + zigzag(front_of(given).wrapping_sub(ahead.expected)),
        });
        let mut front = last_back;
        // A branch lets the processor search for the back before it knows the front: most segments begin where the
        // previous one ends.
        if coded > 0 {
            front = ahead.expected.wrapping_add(unzigzag(coded - 1)) & 0xffff;
            if front < last_back || front == NONE {
                return Err(Misordered([front, front, last_back]));
            }
            left = pass(depths, left, front);
            above = pass(depths, above, front);
        }

        let (context, expected) = back(depths, left, above, front, number == last);
        let coded = backs.code::<false>(context, || zigzag(back_of(given).wrapping_sub(expected)));
        let back = expected.wrapping_add(unzigzag(coded)) & 0xffff;
        if back <= front {
            return Err(Misordered([front, back, last_back]));
        }
        depths[slot] = front | back << 16;

        let (is_left, like_left) = matched(depths, left, front, back);
        let (is_above, like_above) = matched(depths, above, front, back);
        let before = select_unpredictable(is_first, 0, slot - 1);
        let other = select_unpredictable(is_above, like_above, before);
        let a = select_unpredictable(is_left, like_left, other);
        let b = select_unpredictable(is_above, like_above, a);
        let kind = KINDS[usize::from(is_first)][usize::from(is_left) + usize::from(is_above)];
        *link = Neighbors {
            slot: slot as u32,
            like: [a as u32, b as u32],
            thickness: (back - front) as u16,
            kind,
            is_first,
        };
        last_back = back;
    }
    Ok(())
}

fn front_of(depths: u32) -> u32 {
    depths & 0xffff
}

fn back_of(depths: u32) -> u32 {
    depths >> 16
}

/// Moves from a segment of a list to the first one that ends behind `depth`, which is less than [`NONE`].
#[inline(always)]
fn pass(depths: &[u32], at: usize, depth: u32) -> usize {
    // Most moves go one segment on. Where none or one is equally likely, a branch would be mispredicted half of the
    // time.
    let mut at = at + usize::from(back_of(depths[at]) <= depth);
    while back_of(depths[at]) <= depth {
        at += 1;
    }
    at
}

/// Of the first two segments that end behind `front`, returns the one that shares more with `front..back`, and
/// whether it shares any.
#[inline(always)]
fn matched(depths: &[u32], at: usize, front: u32, back: u32) -> (bool, usize) {
    let shared = |s: u32| back_of(s).min(back) as i32 - front_of(s).max(front) as i32;
    let (of_first, of_second) = (shared(depths[at]), shared(depths[at + 1]));
    (of_first.max(of_second) > 0, at + usize::from(of_second > of_first))
}

/// What the neighbours have behind a segment.
struct Ahead {
    /// Of the left neighbour and the upper one: 0 nothing, 1 a segment that goes on, 2 a gap.
    kinds: [usize; 2],
    /// Class of their disagreement about the front of a segment that begins behind a gap.
    disagreement: usize,
    /// The prediction of that front.
    expected: u32,
}

impl Ahead {
    #[inline(always)]
    fn new(depths: &[u32], left: usize, above: usize, last_back: u32) -> Self {
        let kind = |here: u32| {
            let is_gap = usize::from(front_of(here) < NONE) * 2;
            select_unpredictable(front_of(here) <= last_back, 1, is_gap)
        };
        let kinds = [kind(depths[left]), kind(depths[above])];
        // The next front of each neighbour.
        let a = front_of(depths[left + usize::from(kinds[0] == 1)]);
        let b = front_of(depths[above + usize::from(kinds[1] == 1)]);
        // Only a gap tells where a gap ends.
        let a = select_unpredictable(kinds[0] + 4 * kinds[1] == 9, NONE, a);
        let b = select_unpredictable(kinds[0] + 4 * kinds[1] == 6, NONE, b);
        let (disagreement, expected) = agreed(a, b, (last_back + 2).min(NONE));
        Self { kinds, disagreement, expected }
    }

    #[inline(always)]
    fn context(&self, is_first: bool) -> usize {
        let [a, b] = self.kinds;
        let both_gaps = select_unpredictable(a + b == 4, (self.disagreement / 3).min(4), 0);
        let behind_another = usize::from(GAP_CONTEXT[a * 4 + b]) + both_gaps;
        select_unpredictable(is_first, self.disagreement, behind_another)
    }
}

/// The context and the prediction of a back: the neighbours' next back behind `front`. If less than half of that
/// segment is left, the one behind it counts.
#[inline(always)]
fn back(depths: &[u32], left: usize, above: usize, front: u32, is_last: bool) -> (usize, u32) {
    let ahead = |at: usize| {
        let (here, next) = (depths[at], depths[at + 1]);
        let is_behind_middle = front_of(here) + back_of(here) <= 2 * front;
        select_unpredictable(is_behind_middle, back_of(next), back_of(here))
    };
    let (disagreement, expected) = agreed(ahead(left), ahead(above), (front + 1).min(NONE));
    (disagreement + usize::from(is_last) * 15, expected)
}

/// Returns the class of the disagreement of two depths, and a prediction. Two that agree are averaged. Of two that do
/// not, one belongs to another surface, and the nearer one counts. If both are [`NONE`], the prediction is
/// `otherwise`.
#[inline(always)]
fn agreed(a: u32, b: u32, otherwise: u32) -> (usize, u32) {
    let (nearer, farther) = (a.min(b), a.max(b));
    let difference = farther - nearer;
    let mean = nearer + select_unpredictable(difference < AGREE, difference / 2, 0);
    let is_one = farther == NONE;
    let is_none = nearer == NONE;
    let class = select_unpredictable(is_one, 13, octave(difference).min(12));
    let expected = select_unpredictable(is_one, nearer, mean);
    (class + usize::from(is_none), select_unpredictable(is_none, otherwise, expected))
}

/// Codes the optical depths.
#[inline(always)]
fn optical_depths<P: PlaneCoder>(plane: &mut P, scale: &Scale, rows: &mut ListRows) {
    let ListRows { matters, links, .. } = rows;
    let (matters, mut coder) = (&mut matters[..], std::mem::take(plane));
    // Transmittance in front of the segment.
    let mut kappa = 1.0f32;
    for link in links.iter() {
        kappa = if link.is_first { 1.0 } else { kappa };
        let slot = link.slot as usize;
        let given = matters[slot].tau;
        // Optical depths that the neighbours' extinctions give this thickness.
        let log_thickness = scale::log_thickness(link.thickness);
        let [a, b] = link.like.map(|like| {
            let log_extinction = matters[like as usize].log_extinction;
            u32::from(scale.tau_from_log(log_extinction + log_thickness))
        });
        let mut context = link.context(a.abs_diff(b));
        // A branch lets the processor go on to the next segment before it knows this transmittance.
        if kappa < HIDDEN {
            cold_path();
            context += 12;
        }
        let expected = ((a + b) / 2) as u8;
        let coded = coder.code::<true>(context, || zigzag8(given.wrapping_sub(expected)).into());
        let tau = expected.wrapping_add(unzigzag(coded) as u8);
        kappa *= scale.transmittance[usize::from(tau)];
        let matter = &mut matters[slot];
        matter.tau = tau;
        matter.log_extinction = scale.log_tau(tau) - log_thickness;
        matter.inverse_sqrt_alpha = scale.inverse_sqrt_alpha(tau);
    }
    *plane = coder;
}

/// Codes the green channel, and prepares the prediction of the others.
#[inline(always)]
fn greens<P: PlaneCoder>(plane: &mut P, scale: &Scale, rows: &mut ListRows) {
    let ListRows { matters, links, tints, .. } = rows;
    let (matters, mut coder) = (&mut matters[..], std::mem::take(plane));
    let max_code = u32::from(MAX_COLOR_CODE);
    let most = max_code << 6;
    for (link, tint) in links.iter().zip(tints) {
        let slot = link.slot as usize;
        let SegmentCodes { tau, c: [_, given, _], .. } = matters[slot];
        // The neighbours' source colour, in 64ths.
        let times = link.like.map(|like| scale.times(matters[like as usize].inverse_sqrt_alpha, tau));
        let a = source(matters, link.like[0], times[0], 1);
        let b = source(matters, link.like[1], times[1], 1);
        let expected = (a + b).min(most);
        let context = link.context(a.abs_diff(b) >> 5);
        let (green, coded) = channel(&mut coder, max_code, context, (expected + 32) >> 6, given);
        matters[slot].c[1] = green;
        // In 4096ths. The product with a predicted code has 18 fractional bits.
        let turned_out = ((u32::from(green) << 18) / expected.max(1)).min(0xffff);
        let turned_out = select_unpredictable(expected > 64, turned_out, 1 << 12);
        let alone = u16::from(context > 8) * 8;
        *tint = ColorRatio { times, turned_out, coded: coded as u16, alone };
    }
    *plane = coder;
}

/// Codes the two other channels.
#[inline(always)]
fn reds_and_blues<P: PlaneCoder>(planes: [&mut P; 2], rows: &mut ListRows) {
    let ListRows { matters, links, tints, .. } = rows;
    let [red_plane, blue_plane] = planes;
    let (mut reds, mut blues) = (std::mem::take(red_plane), std::mem::take(blue_plane));
    let max_code = u32::from(MAX_COLOR_CODE);
    let most = max_code << 6;
    for (link, tint) in links.iter().zip(tints) {
        let slot = link.slot as usize;
        let [given_red, _, given_blue] = matters[slot].c;
        let expected = |channel: usize| {
            let of = |i: usize| source(matters, link.like[i], tint.times[i], channel);
            ((of(0) + of(1)).min(most) * tint.turned_out + (1 << 17)) >> 18
        };
        let of_green = u32::from(tint.coded);
        let alone = usize::from(tint.alone);
        let (expected_red, expected_blue) = (expected(0), expected(2));
        let context = alone + octave(of_green).min(7);
        let (red, of_red) = channel(&mut reds, max_code, context, expected_red, given_red);
        let context = alone + octave(of_green.max(of_red)).min(7);
        let (blue, _) = channel(&mut blues, max_code, context, expected_blue, given_blue);
        let c = &mut matters[slot].c;
        (c[0], c[2]) = (red, blue);
    }
    (*red_plane, *blue_plane) = (reds, blues);
}

/// A channel of a segment, `times` as bright, in 128ths of a code.
#[inline(always)]
fn source(matters: &[SegmentCodes], like: u32, times: u32, channel: usize) -> u32 {
    (u32::from(matters[like as usize].c[channel]) * times) >> 11
}

impl Neighbors {
    /// The context for two neighbours whose values differ by `difference`.
    #[inline(always)]
    fn context(&self, difference: u32) -> usize {
        let of_two = octave(difference).min(8);
        select_unpredictable(self.kind == 0, of_two, self.kind.into())
    }
}

/// Codes a colour channel. Returns its code and the coded number.
#[inline(always)]
fn channel<P: PlaneCoder>(
    coder: &mut P,
    max_code: u32,
    context: usize,
    expected: u32,
    given: u16,
) -> (u16, u32) {
    let expected = expected.min(max_code);
    let coded = coder.code::<false>(context, || zigzag(u32::from(given).wrapping_sub(expected)));
    ((expected.wrapping_add(unzigzag(coded)) & max_code) as u16, coded)
}

/// Bits of a number without leading zeros.
fn octave(number: u32) -> usize {
    (u32::BITS - number.leading_zeros()) as usize
}

/// Maps a difference modulo 2¹⁶, read as a signed number, to a small one: 0, −1, 1, −2 … become 0, 1, 2, 3 …
fn zigzag(difference: u32) -> u32 {
    let difference = difference as i16;
    u32::from((difference << 1 ^ difference >> 15) as u16)
}

/// The same modulo 2⁸.
fn zigzag8(difference: u8) -> u8 {
    difference << 1 ^ (difference as i8 >> 7) as u8
}

/// Inverse of [`zigzag`], modulo 2¹⁶.
fn unzigzag(number: u32) -> u32 {
    number >> 1 ^ (number & 1).wrapping_neg()
}

/// The depth of a missing segment.
const NONE: u32 = 0xffff;
/// Contexts of a front behind another segment, by the kinds of the left neighbour (in steps of 4) and the upper one.
const GAP_CONTEXT: [u8; 12] = [15, 16, 19, 0, 16, 17, 18, 0, 19, 18, 20, 0];
/// [`Neighbors::kind`] of later segments and of first ones, by the number of like neighbours.
const KINDS: [[u8; 3]; 2] = [[10, 9, 0], [11, 9, 0]];
/// Depths that differ by less belong to the same surface.
const AGREE: u32 = 6;
/// Below this transmittance in front of a segment, its optical depth has other contexts.
const HIDDEN: f32 = 1.0 / 64.0;
