//! Lists to codes: quantisation front to back in a closed loop, and the choice of each list's base.
//!
//! The encoder composites what the decoder will see. Let κ be the transmittance in front of a segment, κ' that of the
//! quantised segments, and e the colour by which the composite so far falls short. The segment's colour is then coded
//! as (κC + e)/κ' and its optical depth as τ plus what is missing so far. What is left of the picture's error is that
//! of the last segment that counts, times its transmittance. So that a segment stays what it is from other poses, a
//! correction changes colour and optical depth by at most an eighth ([`GIVE`]), and ends where κ' is below
//! [`CLOSED_LOOP_LEAST`]: nothing behind is seen from here.
//!
//! On a frame that was decoded every correction is exactly zero, so its codes are found again.
//!
//! In a projection of the greatest key colours are coded as they are, and the segment that has that key keeps a greater
//! code than all others of its list. Of a mean, the sum of colours is what must not drift.

use std::ops::Range;

use super::scale::Scale;
use crate::layer::{LayeredFrame, MAX_K};
use crate::mode::Compositing;

/// One quantised segment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Code {
    pub(super) front: u16,
    pub(super) back: u16,
    pub(super) c: [u16; 3],
    pub(super) tau: u8,
}

/// Consecutive lists: their lengths, and their segments one list after the other.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Lists {
    pub(super) counts: Vec<u8>,
    pub(super) codes: Vec<Code>,
}

/// The lists of one chunk.
#[derive(Default)]
pub(super) struct Group {
    pub(super) lists: Lists,
    /// Sum of α·κ of the segments: how much the picture needs the chunk.
    pub(super) contribution: f64,
}

/// Quantises the lists of a band into its base, of at most `base_k` segments a list, and its refinement.
pub(super) fn band(frame: &LayeredFrame, lists: Range<usize>, base_k: usize, scale: &Scale) -> [Group; 2] {
    let mut groups: [Group; 2] = Default::default();
    for group in &mut groups {
        group.lists.counts.reserve(lists.len());
    }
    let num_segments = (frame.offsets[lists.end] - frame.offsets[lists.start]) as usize;
    groups[0].lists.codes.reserve(num_segments);
    let mut quantized = [Quantized::default(); MAX_K];
    for list in lists {
        let segments = frame.list(list);
        let quantized = &mut quantized[..segments.len().min(MAX_K)];
        match frame.header.mode.compositing() {
            Compositing::Over => quantize_list(frame, segments.start, scale, quantized),
            Compositing::Greatest => quantize_keys(frame, segments.start, scale, quantized),
            Compositing::Mean => quantize_sum(frame, segments.start, scale, quantized),
        }
        let base = base_of(quantized, base_k);
        for group in &mut groups {
            group.lists.counts.push(0);
        }
        for (i, q) in quantized.iter().enumerate() {
            let group = &mut groups[usize::from(base >> i & 1 == 0)];
            group.lists.codes.push(q.code);
            group.contribution += f64::from(q.visible);
            if let Some(count) = group.lists.counts.last_mut() {
                *count += 1;
            }
        }
    }
    groups
}

#[derive(Clone, Copy, Default)]
struct Quantized {
    code: Code,
    /// α·κ.
    visible: f32,
    /// α·max(κ, floor).
    rank: f32,
}

fn quantize_list(frame: &LayeredFrame, first: usize, scale: &Scale, out: &mut [Quantized]) {
    let mut kappa = 1.0f32;
    let mut kappa_coded = 1.0f32;
    let mut missing_c = [0f32; 3];
    let mut missing_tau = 0f32;
    for (i, out) in out.iter_mut().enumerate() {
        let s = frame.segment(first + i);
        let closed = kappa_coded > CLOSED_LOOP_LEAST;
        let tau = if closed {
            let give = s.tau * GIVE + scale.tau[1];
            (s.tau + missing_tau.clamp(-give, give)).max(0.0)
        } else {
            s.tau
        };
        // A depth that was not zero must not become zero by correction either.
        let tau_code = if s.tau > 0.0 { scale.tau_code(tau).max(1) } else { 0 };
        missing_tau += s.tau - scale.tau[usize::from(tau_code)];

        let c = s.c.to_array();
        let mut c_code = [0; 3];
        let per_kappa = 1.0 / kappa_coded;
        for ch in 0..3 {
            let want = if closed {
                let corrected = (c[ch] * kappa + missing_c[ch]) * per_kappa;
                corrected.clamp(c[ch] * (1.0 - GIVE), c[ch] * (1.0 + GIVE))
            } else {
                c[ch]
            };
            c_code[ch] = scale.color_code(want);
            missing_c[ch] += kappa * c[ch] - kappa_coded * scale.color[usize::from(c_code[ch])];
        }

        let transmittance = scale.transmittance[usize::from(tau_code)];
        let alpha = 1.0 - transmittance;
        *out = Quantized {
            code: Code { front: s.front, back: s.back, c: c_code, tau: tau_code },
            visible: alpha * kappa_coded,
            rank: alpha * kappa_coded.max(RANK_FLOOR),
        };
        kappa *= (-s.tau).exp();
        kappa_coded *= transmittance;
    }
}

/// Of a projection of the greatest key.
fn quantize_keys(frame: &LayeredFrame, first: usize, scale: &Scale, out: &mut [Quantized]) {
    let (mut greatest, mut winner) = (0.0, 0);
    for (i, out) in out.iter_mut().enumerate() {
        let s = frame.segment(first + i);
        let c = s.c.to_array().map(|c| scale.color_code(c));
        let tau = scale.tau_code(s.tau).max(1);
        let code = Code { front: s.front, back: s.back, c, tau };
        *out = Quantized { code, visible: brightness(&code, scale), rank: 0.0 };
        if s.tau > greatest {
            (greatest, winner) = (s.tau, i);
        }
    }
    let below = out.get(winner).map_or(1, |q| q.code.tau.saturating_sub(1).max(1));
    for (i, q) in out.iter_mut().enumerate() {
        if i != winner {
            q.code.tau = q.code.tau.min(below);
        }
        // Of what is coded, so that a decoded frame has the same base.
        q.rank = scale.tau[usize::from(q.code.tau)];
    }
}

/// The greatest channel of what is coded.
fn brightness(code: &Code, scale: &Scale) -> f32 {
    scale.color[usize::from(code.c.into_iter().max().unwrap_or(0))]
}

/// Of a projection of the mean.
fn quantize_sum(frame: &LayeredFrame, first: usize, scale: &Scale, out: &mut [Quantized]) {
    let mut missing = [0f32; 3];
    for (i, out) in out.iter_mut().enumerate() {
        let s = frame.segment(first + i);
        let mut code = Code { front: s.front, back: s.back, c: [0; 3], tau: 0 };
        for (ch, c) in s.c.to_array().into_iter().enumerate() {
            let want = (c + missing[ch]).clamp(c * (1.0 - GIVE), c * (1.0 + GIVE));
            code.c[ch] = scale.color_code(want);
            missing[ch] += c - scale.color[usize::from(code.c[ch])];
        }
        let visible = brightness(&code, scale);
        *out = Quantized { code, visible, rank: visible };
    }
}

/// Bit `i` says that segment `i` belongs to the base: the `base_k` highest ranks, the nearer first among equals.
fn base_of(list: &[Quantized], base_k: usize) -> u32 {
    let mut base = 0u32;
    if list.len() <= base_k {
        return u32::MAX;
    }
    for _ in 0..base_k {
        let best = (0..list.len())
            .filter(|&i| base >> i & 1 == 0)
            .reduce(|a, b| if list[b].rank > list[a].rank { b } else { a });
        base |= best.map_or(0, |i| 1 << i);
    }
    base
}

/// Greatest relative change of a segment by correction. A step of the scale of τ changes κ by up to 2 % (at τ = 2)
/// and its carried error by as much again.
pub(super) const GIVE: f32 = 0.125;
/// Transmittance below which a picture of 8 bits shows nothing.
const CLOSED_LOOP_LEAST: f32 = 1.0 / 1024.0;
/// Transmittance that hidden segments are ranked with, so that among them the denser come first.
const RANK_FLOOR: f32 = 1.0 / 64.0;
