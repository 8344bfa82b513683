//! Quantises lists front to back in a closed loop.
//!
//! The encoder composites what the decoder will see. Let κ be the transmittance in front of a segment, κ' that of the
//! quantised segments, and e the colour that the composite lacks so far. The segment's colour is coded as (κC +
//! e)/κ', and its optical depth as τ plus the missing optical depth so far. The picture keeps only the error of the
//! last visible segment, times its transmittance. A correction changes colour and optical depth by at most an eighth
//! ([`GIVE`]), so a segment looks right from other poses. Corrections end where κ' is below [`CLOSED_LOOP_LEAST`],
//! because nothing behind is visible.
//!
//! For a decoded frame every correction is exactly zero, so quantisation finds the same codes again.
//!
//! In a projection of the greatest key, colours are coded without correction. The segment with that key keeps a
//! greater code than all others of its list. In a mean, the sum of colours must not drift.

use std::ops::Range;

use super::super::bands::split_off;
use super::scale::{Scale, scale};
use crate::layer::LayeredFrame;
use crate::mode::Compositing;

/// One quantised segment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Code {
    pub(super) front: u16,
    pub(super) back: u16,
    pub(super) c: [u16; 3],
    pub(super) tau: u8,
}

/// Consecutive lists: their lengths, and all their segments in order.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct CodedLists {
    pub(super) counts: Vec<u8>,
    pub(super) codes: Vec<Code>,
}

/// Quantises the lists of a band.
pub(super) fn band(frame: &LayeredFrame, lists: Range<usize>) -> CodedLists {
    let num_segments = (frame.offsets[lists.end] - frame.offsets[lists.start]) as usize;
    let mut counts = Vec::with_capacity(lists.len());
    let mut codes = vec![Code::default(); num_segments];
    let mut rest = &mut codes[..];
    let quantize = match frame.header.mode.compositing() {
        Compositing::Over => quantize_list,
        Compositing::Greatest => quantize_keys,
        Compositing::Mean => quantize_sum,
    };
    for list in lists {
        let segments = frame.list(list);
        counts.push(segments.len() as u8);
        quantize(frame, segments.start, scale(), split_off(&mut rest, segments.len()));
    }
    CodedLists { counts, codes }
}

fn quantize_list(frame: &LayeredFrame, first: usize, scale: &Scale, out: &mut [Code]) {
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
        // A correction must not make a positive depth zero.
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

        *out = Code { front: s.front, back: s.back, c: c_code, tau: tau_code };
        kappa *= (-s.tau).exp();
        kappa_coded *= scale.transmittance[usize::from(tau_code)];
    }
}

/// Quantises a list of a projection of the greatest key.
fn quantize_keys(frame: &LayeredFrame, first: usize, scale: &Scale, out: &mut [Code]) {
    let (mut greatest, mut winner) = (0.0, 0);
    for (i, out) in out.iter_mut().enumerate() {
        let s = frame.segment(first + i);
        let c = s.c.to_array().map(|c| scale.color_code(c));
        *out = Code { front: s.front, back: s.back, c, tau: scale.tau_code(s.tau).max(1) };
        if s.tau > greatest {
            (greatest, winner) = (s.tau, i);
        }
    }
    let below = out.get(winner).map_or(1, |code| code.tau.saturating_sub(1).max(1));
    for (_, code) in out.iter_mut().enumerate().filter(|(i, _)| *i != winner) {
        code.tau = code.tau.min(below);
    }
}

/// Quantises a list of a projection of the mean.
fn quantize_sum(frame: &LayeredFrame, first: usize, scale: &Scale, out: &mut [Code]) {
    let mut missing = [0f32; 3];
    for (i, out) in out.iter_mut().enumerate() {
        let s = frame.segment(first + i);
        *out = Code { front: s.front, back: s.back, c: [0; 3], tau: 0 };
        for (ch, c) in s.c.to_array().into_iter().enumerate() {
            let want = (c + missing[ch]).clamp(c * (1.0 - GIVE), c * (1.0 + GIVE));
            out.c[ch] = scale.color_code(want);
            missing[ch] += c - scale.color[usize::from(out.c[ch])];
        }
    }
}

/// Greatest relative change of a segment by correction. A step of τ changes κ by up to 2 % (at τ = 2), and the
/// carried error by as much again.
pub(super) const GIVE: f32 = 0.125;
/// Below this transmittance an 8-bit picture shows nothing.
const CLOSED_LOOP_LEAST: f32 = 1.0 / 1024.0;
