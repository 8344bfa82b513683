//! What a segment is expected to be, from the lists to the left and above and the segments in front of it, and how sure
//! that is: the context it is coded in. Encoder and decoder both run this, so it uses exact arithmetic only: integers,
//! tables made of sums and products (`scale`), and one product of IEEE floats, the transmittance in front.
//!
//! Surfaces go on from list to list, while numbers of segments do not: a segment is compared with those of
//! the neighbours at its own depth, not with those of its own number. Colour depends on how much matter of its kind
//! a segment holds: C is E·α, and on the square-root scale its code goes with √α. So the optical depth is expected from
//! the thickness and the neighbours' extinction, green from the optical depth, and red and blue as green turned out.

use super::contexts::{BACK, BLUE, Coder, FRONT, GREEN, RED, TAU};
use super::quantize::Code;
use super::scale::{LEAST_LOG_EXTINCTION, Scale};

/// A segment that lies in front of the one before it in its list, or holds nothing: front, back, and the back before.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Misordered(pub(super) [u16; 3]);

/// A row of lists.
#[derive(Clone, Copy)]
pub(super) struct Row<'a> {
    /// Length of each list; none in place of the row above the first.
    pub(super) counts: &'a [u8],
    /// The segments, one list after the other.
    pub(super) codes: &'a [Code],
}

/// Codes the segments of a row of lists of lengths `counts` below another. A decoder fills in `codes`.
pub(super) fn row<C: Coder>(
    coder: &mut C,
    scale: &Scale,
    above: Row<'_>,
    counts: &[u8],
    codes: &mut [Code],
) -> Result<(), Misordered> {
    #[cfg(target_arch = "x86_64")]
    if has_wide_instructions() {
        #[expect(unsafe_code, reason = "the one way to instructions that not every processor has")]
        // SAFETY: this processor has them.
        return unsafe { row_wide(coder, scale, above, counts, codes) };
    }
    lists(coder, scale, above, counts, codes)
}

#[cfg(target_arch = "x86_64")]
fn has_wide_instructions() -> bool {
    is_x86_feature_detected!("avx2")
        && is_x86_feature_detected!("bmi1")
        && is_x86_feature_detected!("bmi2")
        && is_x86_feature_detected!("lzcnt")
}

/// The same with instructions for shifts and leading zeros. No multiplication is fused with an addition.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,bmi1,bmi2,lzcnt")]
fn row_wide<C: Coder>(
    coder: &mut C,
    scale: &Scale,
    above: Row<'_>,
    counts: &[u8],
    codes: &mut [Code],
) -> Result<(), Misordered> {
    lists(coder, scale, above, counts, codes)
}

#[inline(always)]
fn lists<C: Coder>(
    coder: &mut C,
    scale: &Scale,
    above: Row<'_>,
    counts: &[u8],
    codes: &mut [Code],
) -> Result<(), Misordered> {
    let (mut left, mut own, mut over) = (0, 0, 0);
    for (column, &count) in counts.iter().enumerate() {
        let over_end = over + above.counts.get(column).map_or(0, |&count| usize::from(count));
        if count > 0 {
            let (before, rest) = codes.split_at_mut(own);
            let neighbours = [&before[left..], &above.codes[over..over_end]];
            list(coder, scale, neighbours, &mut rest[..usize::from(count)])?;
        }
        left = own;
        own += usize::from(count);
        over = over_end;
    }
    Ok(())
}

/// The context of a list's length between those to the left and above.
pub(super) fn length_context(left: u8, above: u8) -> usize {
    usize::from((u16::from(left) + u16::from(above)).div_ceil(2).min(11)) * 3
        + usize::from(left.abs_diff(above).min(2))
}

#[inline(always)]
fn list<C: Coder>(
    coder: &mut C,
    scale: &Scale,
    [left, above]: [&[Code]; 2],
    own: &mut [Code],
) -> Result<(), Misordered> {
    let (mut left, mut above) = (Cursor::new(left), Cursor::new(above));
    let mut before = Code { back: 0, ..NOTHING };
    let mut kappa = 1.0f32;
    let num_segments = own.len();
    for (number, slot) in own.iter_mut().enumerate() {
        let place = Place { before, is_first: number == 0, is_last: number + 1 == num_segments, kappa };
        let (front, back) = depths(coder, &mut left, &mut above, &place, slot)?;
        before = matter(coder, scale, &left, &above, &place, slot, front, back);
        *slot = before;
        kappa *= scale.transmittance[usize::from(before.tau)];
    }
    Ok(())
}

/// A segment's place in its list.
struct Place {
    /// The segment in front of it.
    before: Code,
    is_first: bool,
    is_last: bool,
    /// Transmittance in front of it.
    kappa: f32,
}

/// Codes where a segment begins and ends, and moves the cursors to it.
#[inline(always)]
fn depths<C: Coder>(
    coder: &mut C,
    left: &mut Cursor<'_>,
    above: &mut Cursor<'_>,
    place: &Place,
    given: &Code,
) -> Result<(u16, u16), Misordered> {
    let last_back = place.before.back;
    if last_back == NOTHING.front {
        return Err(Misordered([last_back; 3]));
    }
    left.pass(last_back);
    above.pass(last_back);
    let ahead = Ahead::new(left, above, last_back);
    let coded = coder.code(FRONT, ahead.context(place.is_first), || match given.front == last_back {
        true => 0,
        false => 1 + u32::from(zigzag(given.front.wrapping_sub(ahead.expected().1))),
    });
    let mut front = last_back;
    if coded > 0 {
        front = ahead.expected().1.wrapping_add(unzigzag(coded - 1));
        if front < last_back || front == NOTHING.front {
            return Err(Misordered([front, front, last_back]));
        }
        left.pass(front);
        above.pass(front);
    }

    let (context, expected) = back(left, above, front, place.is_last);
    let coded = coder.code(BACK, context, || zigzag(given.back.wrapping_sub(expected)).into());
    let back = expected.wrapping_add(unzigzag(coded));
    if back <= front {
        return Err(Misordered([front, back, last_back]));
    }
    Ok((front, back))
}

/// Codes what a segment holds; the cursors stand at it.
#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "the state of one loop, which is kept in registers")]
fn matter<C: Coder>(
    coder: &mut C,
    scale: &Scale,
    left: &Cursor<'_>,
    above: &Cursor<'_>,
    place: &Place,
    given: &Code,
    front: u16,
    back: u16,
) -> Code {
    let near = Near::new(left.matched(front, back), above.matched(front, back), place);
    let (context, expected) = near.tau(scale, back - front);
    let context = context + if place.kappa < HIDDEN { 12 } else { 0 };
    let coded = coder.code(TAU, context, || zigzag8(given.tau.wrapping_sub(expected)).into());
    let tau = expected.wrapping_add(unzigzag(coded) as u8);

    let (context, expected) = near.color(scale, tau);
    let expected_green = (expected[1] + 32) >> 6;
    let (green, of_green) = channel(coder, scale, GREEN, context, expected_green, given.c[1]);
    // In 4096ths; the product of both has 18 bits below one.
    let times = if expected[1] > 64 { ((u32::from(green) << 18) / expected[1]).min(0xffff) } else { 1 << 12 };
    let scaled = |ch: usize| (expected[ch] * times + (1 << 17)) >> 18;
    let alone = if context > 8 { 8 } else { 0 };
    let context = alone + octave(of_green).min(7);
    let (red, of_red) = channel(coder, scale, RED, context, scaled(0), given.c[0]);
    let context = alone + octave(of_green.max(of_red)).min(7);
    let (blue, _) = channel(coder, scale, BLUE, context, scaled(2), given.c[2]);
    Code::new(scale, front, back, [red, green, blue], tau)
}

/// Codes a colour channel: its code, and the number that was coded.
#[inline(always)]
fn channel<C: Coder>(
    coder: &mut C,
    scale: &Scale,
    plane: usize,
    context: usize,
    expected: u32,
    given: u16,
) -> (u16, u32) {
    let expected = scale.clamp_code(expected);
    let coded = coder.code(plane, context, || zigzag(given.wrapping_sub(expected)).into());
    (expected.wrapping_add(unzigzag(coded)) & scale.max_code(), coded)
}

/// A place in a neighbouring list that only goes backwards in depth: a segment and the one behind it. Behind the list is
/// [`NOTHING`].
struct Cursor<'a> {
    here: &'a Code,
    next: &'a Code,
    rest: std::slice::Iter<'a, Code>,
}

impl<'a> Cursor<'a> {
    #[inline(always)]
    fn new(list: &'a [Code]) -> Self {
        let mut rest = list.iter();
        let here = rest.next().unwrap_or(&NOTHING);
        let next = rest.next().unwrap_or(&NOTHING);
        Self { here, next, rest }
    }

    /// Goes on to the first segment that ends behind `depth`, which is less than that of [`NOTHING`].
    #[inline(always)]
    fn pass(&mut self, depth: u16) {
        while self.here.back <= depth {
            self.here = self.next;
            self.next = self.rest.next().unwrap_or(&NOTHING);
        }
    }

    /// Of the first two segments that end behind `front`, the one that shares more with `front..back`, if it shares any.
    #[inline(always)]
    fn matched(&self, front: u16, back: u16) -> Option<&'a Code> {
        let (front, back) = (i32::from(front), i32::from(back));
        let shared = |s: &Code| i32::from(s.back).min(back) - i32::from(s.front).max(front);
        let (first, second) = (self.here, self.next);
        let (of_first, of_second) = (shared(first), shared(second));
        let (most, best) = if of_second > of_first { (of_second, second) } else { (of_first, first) };
        (most > 0).then_some(best)
    }
}

/// What the neighbours have behind a segment, where their cursors stand.
struct Ahead {
    /// Of the left neighbour and the upper one: 0 nothing, 1 a segment that goes on, 2 a gap.
    kinds: (usize, usize),
    /// Where each has the next front.
    fronts: (u16, u16),
    last_back: u16,
}

impl Ahead {
    #[inline(always)]
    fn new(left: &Cursor<'_>, above: &Cursor<'_>, last_back: u16) -> Self {
        let kind = |cursor: &Cursor<'_>| match cursor.here.front {
            front if front <= last_back => 1,
            front => usize::from(front < NOTHING.front) * 2,
        };
        let front = |cursor: &Cursor<'_>, kind| if kind == 1 { cursor.next.front } else { cursor.here.front };
        let kinds = (kind(left), kind(above));
        Self { kinds, fronts: (front(left, kinds.0), front(above, kinds.1)), last_back }
    }

    /// How much they disagree on the front of a segment that begins behind a gap, and where it is expected.
    #[inline(always)]
    fn expected(&self) -> (usize, u16) {
        let (a, b) = self.fronts;
        // Only a gap tells where a gap ends.
        match self.kinds {
            (1, 2) => agreed(NOTHING.front, b, 0),
            (2, 1) => agreed(a, NOTHING.front, 0),
            _ => agreed(a, b, self.last_back.saturating_add(2)),
        }
    }

    #[inline(always)]
    fn context(&self, is_first: bool) -> usize {
        let (a, b) = self.kinds;
        if is_first {
            return self.expected().0;
        }
        let both_gaps = if a + b == 4 { (self.expected().0 / 3).min(4) } else { 0 };
        usize::from(GAP_CONTEXT[a * 3 + b]) + both_gaps
    }
}

/// The context of a back and what it is expected to be: the next end behind `front`, where the cursors stand, but of
/// a segment of which less than a half is left, that of the one behind.
#[inline(always)]
fn back(left: &Cursor<'_>, above: &Cursor<'_>, front: u16, is_last: bool) -> (usize, u16) {
    let ahead = |cursor: &Cursor<'_>| {
        let is_left = u32::from(cursor.here.front) + u32::from(cursor.here.back) > 2 * u32::from(front);
        if is_left { cursor.here.back } else { cursor.next.back }
    };
    let (disagreement, expected) = agreed(ahead(left), ahead(above), front.saturating_add(1));
    (disagreement + if is_last { 15 } else { 0 }, expected)
}

/// How much two depths disagree, and what is expected of them: two that agree are averaged; of two that do not, one belongs
/// to another surface, and the nearer comes first. A depth of 65535 is none; if both are, `otherwise` is expected.
#[inline(always)]
fn agreed(a: u16, b: u16, otherwise: u16) -> (usize, u16) {
    let (nearer, farther) = (a.min(b), a.max(b));
    let difference = farther - nearer;
    let expected = if difference < AGREE { nearer + difference / 2 } else { nearer };
    if nearer == NOTHING.back {
        (14, otherwise)
    } else if farther == NOTHING.back {
        (13, nearer)
    } else {
        (octave(difference.into()).min(12), expected)
    }
}

/// The two segments that another is expected to be like: those to the left and above that share its depths, one twice if
/// there is no other, or twice the one before it.
struct Near<'a> {
    a: &'a Code,
    b: &'a Code,
    /// 0 if there are two, else 9 for one, 10 for the one before, 11 for none.
    context: usize,
}

impl<'a> Near<'a> {
    #[inline(always)]
    fn new(left: Option<&'a Code>, above: Option<&'a Code>, place: &'a Place) -> Self {
        match (left, above) {
            (Some(a), Some(b)) => Self { a, b, context: 0 },
            (Some(a), None) | (None, Some(a)) => Self { a, b: a, context: 9 },
            (None, None) => {
                Self { a: &place.before, b: &place.before, context: 10 + usize::from(place.is_first) }
            }
        }
    }

    #[inline(always)]
    fn context(&self, difference: u32) -> usize {
        if self.context == 0 { octave(difference).min(8) } else { self.context }
    }

    /// The context of an optical depth and its expected code: that of the neighbours' extinction.
    #[inline(always)]
    fn tau(&self, scale: &Scale, thickness: u16) -> (usize, u8) {
        let a = scale.tau_from_log(self.a.log_extinction, thickness);
        let b = scale.tau_from_log(self.b.log_extinction, thickness);
        (self.context(a.abs_diff(b).into()), ((u16::from(a) + u16::from(b)) / 2) as u8)
    }

    /// The context of green and the expected codes of red, green and blue in 64ths: those of the neighbours' source colour.
    #[inline(always)]
    fn color(&self, scale: &Scale, tau: u8) -> (usize, [u32; 3]) {
        let (times_a, times_b) = (scale.times(self.a.tau, tau), scale.times(self.b.tau, tau));
        let most = u32::from(scale.max_code()) << 6;
        let a = |ch: usize| (u32::from(self.a.c[ch]) * times_a) >> 11;
        let b = |ch: usize| (u32::from(self.b.c[ch]) * times_b) >> 11;
        let sum = [0, 1, 2].map(|ch| (a(ch) + b(ch)).min(most));
        let difference = a(1).abs_diff(b(1)) >> 5;
        (self.context(difference), sum)
    }
}

/// Bits of a number without leading zeros.
fn octave(number: u32) -> usize {
    (u32::BITS - number.leading_zeros()) as usize
}

/// A difference modulo 2¹⁶ taken as the signed number nearest to zero: 0, −1, 1, −2 … become 0, 1, 2, 3 …
fn zigzag(difference: u16) -> u16 {
    difference << 1 ^ (difference as i16 >> 15) as u16
}

/// The same modulo 2⁸.
fn zigzag8(difference: u8) -> u8 {
    difference << 1 ^ (difference as i8 >> 7) as u8
}

/// Inverse of [`zigzag`], for the low 16 bits of a number.
fn unzigzag(number: u32) -> u16 {
    (number >> 1 ^ (number & 1).wrapping_neg()) as u16
}

/// What is behind the last segment of a list, and in front of its first: farther than anything, and empty.
const NOTHING: Code =
    Code { front: u16::MAX, back: u16::MAX, c: [0; 3], tau: 0, log_extinction: LEAST_LOG_EXTINCTION };
/// Contexts of a front behind another segment, by what the left and the upper neighbour have there.
const GAP_CONTEXT: [u8; 9] = [15, 16, 19, 16, 17, 18, 19, 18, 20];
/// Depths that differ by less are of the same surface.
const AGREE: u16 = 6;
/// Transmittance in front of a segment below which its optical depth is coded in other contexts.
const HIDDEN: f32 = 1.0 / 64.0;
