//! A layered frame as planes that image codecs take, and back. Frames are cut at equal shares of the accumulated
//! opacity ([`Rule::EqualTransmittance`]): only there do layers meet without gaps, so that k + 1 depths are enough.
//!
//! [`Layout::Published`] is Lochmann 2016, section 4.3: for each layer colour C and opacity α, and k + 1 depths; what
//! has no matter is zero. [`Layout::Weighted`] gives an image codec the transforms that help it most: colour by what
//! it adds to the picture, W_i = k·κ_i·C_i with κ_i = 1 − (i/k)·α, κ_i being the transmittance in front of layer i;
//! the opacity α of the whole list once, from which equal shares give every layer's; and depths at a fraction of the
//! resolution, continued into where there is no matter.
//!
//! Both send square roots of colours, as pictures do, and both decoders clamp a layer's colour to what its opacity
//! can emit: ringing beside an edge costs the rivals more than anything else.

use crate::rules::Rule;
use glam::Vec3;
use isinglass_core::layer::{DEPTH_UNITS, FrameHeader, LayeredFrame, Segment};

use super::raster::Raster;

/// The planes that a frame is sent as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Layout {
    /// As in Lochmann 2016.
    Published,
    /// With the transforms above.
    Weighted,
}

/// Planes of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// k rasters of three channels.
    Color,
    /// k rasters, or one.
    Opacity,
    /// k + 1 rasters.
    Depth,
}

impl Part {
    /// In the order of reports.
    pub(crate) const ALL: [Self; 3] = [Self::Color, Self::Opacity, Self::Depth];
}

impl Layout {
    pub(crate) const LAYERING: Rule = Rule::EqualTransmittance;

    /// The planes of a part with at most `max_bits` a sample. Those of [`Layout::Weighted`] are `divisor` times
    /// smaller on either side.
    pub(crate) fn split(self, frame: &LayeredFrame, part: Part, max_bits: u8, divisor: u32) -> Vec<Raster> {
        let intrinsics = frame.header.camera.intrinsics;
        let size = [intrinsics.width, intrinsics.height];
        let k = usize::from(frame.header.k);
        let lists: Vec<Vec<Segment>> =
            (0..intrinsics.num_pixels()).map(|i| frame.list(i).map(|s| frame.segment(s)).collect()).collect();
        let bits = |wanted: u8| wanted.min(max_bits);
        match (part, self) {
            (Part::Color, Self::Published) => (0..k)
                .map(|j| {
                    let c = lists.iter().flat_map(|l| l.get(j).map_or([0.0; 3], |s| s.c.to_array()));
                    Raster::from_units(size, 3, bits(8), &c.map(f32::sqrt).collect::<Vec<_>>())
                })
                .collect(),
            (Part::Color, Self::Weighted) => {
                let mut planes = vec![Vec::with_capacity(3 * lists.len()); k];
                for list in &lists {
                    let mut kappa = 1.0;
                    for (j, plane) in planes.iter_mut().enumerate() {
                        let segment = list.get(j).copied().unwrap_or_default();
                        let w = segment.c * (kappa * k as f32 / W_MAX);
                        plane.extend(w.to_array().map(f32::sqrt));
                        kappa *= (-segment.tau).exp();
                    }
                }
                let smaller = planes.iter().map(|w| halved(w, 3, size, divisor));
                smaller.map(|(size, w)| Raster::from_units(size, 3, bits(WEIGHTED_BITS), &w)).collect()
            }
            (Part::Opacity, Self::Published) => (0..k)
                .map(|j| {
                    let alpha: Vec<f32> =
                        lists.iter().map(|l| l.get(j).map_or(0.0, Segment::alpha)).collect();
                    Raster::from_units(size, 1, bits(8), &alpha)
                })
                .collect(),
            (Part::Opacity, Self::Weighted) => {
                let root = |l: &Vec<Segment>| (l.iter().map(|s| s.tau).sum::<f32>() / TAU_FULL).sqrt();
                let values: Vec<f32> = lists.iter().map(root).collect();
                let (size, values) = halved(&values, 1, size, divisor);
                vec![Raster::from_units(size, 1, bits(WEIGHTED_BITS), &values)]
            }
            (Part::Depth, _) => (0..=k)
                .map(|j| {
                    let depth =
                        lists.iter().map(|l| boundary(l, j).map(|units| f32::from(units) / DEPTH_UNITS));
                    let depth: Vec<Option<f32>> = depth.collect();
                    if self == Self::Published {
                        let zero_filled: Vec<f32> = depth.iter().map(|d| d.unwrap_or(0.0)).collect();
                        return Raster::from_units(size, 1, bits(16), &zero_filled);
                    }
                    let (small, values) = shrink(&fill(&depth, size), &depth, size, divisor);
                    Raster::from_units(small, 1, bits(16), &values)
                })
                .collect(),
        }
    }

    /// The frame of decoded planes; `header` is that of the frame that was split. Valid whatever the planes hold.
    pub(crate) fn join(
        self,
        header: FrameHeader,
        color: &[Raster],
        opacity: &[Raster],
        depth: &[Raster],
    ) -> LayeredFrame {
        let intrinsics = header.camera.intrinsics;
        let size = [intrinsics.width, intrinsics.height];
        let [color, opacity, depth] = [color, opacity, depth]
            .map(|planes| planes.iter().map(|raster| enlarge(raster, size)).collect::<Vec<_>>());
        let k = color.len();
        let mut frame = LayeredFrame::empty(header);
        for i in 0..intrinsics.num_pixels() {
            let mut last = 0;
            // α of the list, or of its layer.
            let whole = if self == Self::Weighted {
                let root = opacity[0][i];
                1.0 - (-TAU_FULL * root * root).exp()
            } else {
                0.0
            };
            for j in 0..k {
                let root = Vec3::from_slice(&color[j][3 * i..3 * i + 3]);
                let (alpha, c) = match self {
                    Self::Published => (opacity[j][i], root * root),
                    Self::Weighted => {
                        let kappa = 1.0 - whole * j as f32 / k as f32;
                        (whole / k as f32 / kappa, root * root * (W_MAX / (k as f32 * kappa)))
                    }
                };
                if alpha < LEAST_ALPHA {
                    continue;
                }
                let units = |plane: &[f32]| (plane[i].clamp(0.0, 1.0) * DEPTH_UNITS + 0.5) as u16;
                let front = units(&depth[j]).max(last);
                // A layer that lost its thickness becomes a thin one.
                let back = units(&depth[j + 1]).max(front.saturating_add(LEAST_UNITS));
                if back <= front {
                    break;
                }
                let tau = -(1.0 - alpha.min(ALPHA_MAX)).ln();
                let c = c.min(Vec3::splat(EMISSION_MAX * alpha));
                frame.push(&Segment { front, back, c, tau });
                last = back;
            }
            frame.offsets[i + 1] = frame.depth.len() as u32;
        }
        frame
    }
}

/// Depth `j` of a list: the front of its layer `j`, or its end; none if it is empty.
fn boundary(list: &[Segment], j: usize) -> Option<u16> {
    list.get(j).map(|s| s.front).or(list.last().map(|s| s.back))
}

/// Continues what is there to everywhere: the mean of ever larger squares, smoothly (pull and push).
fn fill(values: &[Option<f32>], size: [u32; 2]) -> Vec<f32> {
    let [width, height] = size.map(|s| s as usize);
    if width == 1 && height == 1 {
        return vec![values[0].unwrap_or(0.0)];
    }
    let half = [width.div_ceil(2), height.div_ceil(2)];
    let coarse: Vec<Option<f32>> = (0..half[0] * half[1])
        .map(|i| mean(values, [width, height], [i % half[0], i / half[0]], 2))
        .collect();
    let coarse = fill(&coarse, half.map(|s| s as u32));
    let at = |i: usize| values[i].unwrap_or_else(|| bilinear(&coarse, half, [i % width, i / width], 2));
    (0..values.len()).map(at).collect()
}

/// Mean of what is there in a square of `divisor`.
fn mean(values: &[Option<f32>], size: [usize; 2], square: [usize; 2], divisor: usize) -> Option<f32> {
    let (mut sum, mut num) = (0.0, 0.0);
    for y in square[1] * divisor..((square[1] + 1) * divisor).min(size[1]) {
        for x in square[0] * divisor..((square[0] + 1) * divisor).min(size[0]) {
            if let Some(value) = values[y * size[0] + x] {
                (sum, num) = (sum + value, num + 1.0);
            }
        }
    }
    (num > 0.0).then(|| sum / num)
}

/// Smaller by `divisor`: means of what there is, elsewhere of what was filled in.
fn shrink(filled: &[f32], values: &[Option<f32>], size: [u32; 2], divisor: u32) -> ([u32; 2], Vec<f32>) {
    if divisor <= 1 {
        return (size, filled.to_vec());
    }
    let small = size.map(|s| s.div_ceil(divisor));
    let filled: Vec<Option<f32>> = filled.iter().map(|x| Some(*x)).collect();
    let large = size.map(|s| s as usize);
    let shrunk = (0..small[1] as usize)
        .flat_map(|y| (0..small[0] as usize).map(move |x| [x, y]))
        .map(|at| {
            let of = |values| mean(values, large, at, divisor as usize);
            of(values).or(of(&filled)).unwrap_or(0.0)
        })
        .collect();
    (small, shrunk)
}

/// Smaller by `divisor`, all channels of a sample together: means.
fn halved(values: &[f32], channels: usize, size: [u32; 2], divisor: u32) -> ([u32; 2], Vec<f32>) {
    if divisor <= 1 {
        return (size, values.to_vec());
    }
    let small = size.map(|s| s.div_ceil(divisor));
    let mut out = vec![0.0; small[0] as usize * small[1] as usize * channels];
    for c in 0..channels {
        let of_channel: Vec<f32> = values.iter().skip(c).step_by(channels).copied().collect();
        let there: Vec<Option<f32>> = of_channel.iter().map(|x| Some(*x)).collect();
        let (_, shrunk) = shrink(&of_channel, &there, size, divisor);
        out.iter_mut().skip(c).step_by(channels).zip(shrunk).for_each(|(out, x)| *out = x);
    }
    (small, out)
}

/// The reverse of [`shrink`] and [`halved`], smoothly.
fn enlarge(raster: &Raster, size: [u32; 2]) -> Vec<f32> {
    let values: Vec<f32> = (0..raster.samples.len()).map(|i| raster.unit(i)).collect();
    let divisor = size[0].div_ceil(raster.width.max(1)).max(1);
    if divisor == 1 {
        return values;
    }
    let small = [raster.width as usize, raster.height as usize];
    let (width, channels) = (size[0] as usize, usize::from(raster.channels));
    let mut out = vec![0.0; width * size[1] as usize * channels];
    for c in 0..channels {
        let of_channel: Vec<f32> = values.iter().skip(c).step_by(channels).copied().collect();
        for (i, out) in out.iter_mut().skip(c).step_by(channels).enumerate() {
            *out = bilinear(&of_channel, small, [i % width, i / width], divisor as usize);
        }
    }
    out
}

/// The value of a plane at a pixel of one that is `divisor` times larger.
fn bilinear(plane: &[f32], size: [usize; 2], pixel: [usize; 2], divisor: usize) -> f32 {
    let at = |axis: usize| {
        let x = ((pixel[axis] as f32 + 0.5) / divisor as f32 - 0.5).clamp(0.0, (size[axis] - 1) as f32);
        (x as usize, (x as usize + 1).min(size[axis] - 1), x.fract())
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (at(0), at(1));
    let row = |y: usize| plane[y * size[0] + x0] * (1.0 - fx) + plane[y * size[0] + x1] * fx;
    row(y0) * (1.0 - fy) + row(y1) * fy
}

/// Greatest W: the opacity of a list times the greatest emission, as shading can lift a colour a little above one.
const W_MAX: f32 = 1.25;
/// Bits of weighted colour and opacity: codecs that lose anyway lose nothing by more.
const WEIGHTED_BITS: u8 = 10;
/// Optical depth of an opaque list; e^−10 is nothing in 8 bits.
const TAU_FULL: f32 = 10.0;
/// Least visible opacity: half a step of 8 bits.
const LEAST_ALPHA: f32 = 0.002;
/// An opacity of one has no finite optical depth.
const ALPHA_MAX: f32 = 0.9999;
/// Greatest colour over opacity.
const EMISSION_MAX: f32 = 1.1;
/// Thickness of a layer whose depths were coded to the same, depth units: a sixteenth of a pixel at 512 lines.
const LEAST_UNITS: u16 = 8;

#[cfg(test)]
mod tests {
    use super::super::tests::frame;
    use super::*;

    fn rejoined(layout: Layout, frame: &LayeredFrame, bits: u8, divisors: [u32; 3]) -> LayeredFrame {
        let mut divisors = divisors.into_iter();
        let [color, opacity, depth] =
            Part::ALL.map(|part| layout.split(frame, part, bits, divisors.next().unwrap()));
        let joined = layout.join(frame.header, &color, &opacity, &depth);
        joined.validate().unwrap();
        joined
    }

    fn error(a: &LayeredFrame, b: &LayeredFrame) -> f32 {
        let (a, b) = (a.flatten(), b.flatten());
        let differences =
            a.pixels.iter().flatten().zip(b.pixels.iter().flatten()).map(|(x, y)| (x - y).abs());
        differences.fold(0.0, f32::max)
    }

    #[test]
    fn planes_give_back_the_frame_up_to_their_bits() {
        let frame = frame(Layout::LAYERING, 4);
        for layout in [Layout::Published, Layout::Weighted] {
            let same = rejoined(layout, &frame, 16, [1; 3]);
            // Half a step of 8 bits on the root of C is up to 1/255 on C and half that on α, and four layers are over
            // one another. Weighted: half a step of 10 bits, and what is below LEAST_ALPHA.
            assert!(error(&frame, &same) < 0.02, "{layout:?}: {}", error(&frame, &same));
            let coarse = rejoined(layout, &frame, 3, [1; 3]);
            assert!(error(&frame, &coarse) > 0.04, "{layout:?}: {}", error(&frame, &coarse));
            // Depths are all there: what is not lost has the end points it had.
            let ends = |f: &LayeredFrame| f.depth.iter().map(|d| u64::from(d >> 16)).sum::<u64>();
            let (a, b) =
                (ends(&frame) / frame.num_segments() as u64, ends(&same) / same.num_segments() as u64);
            assert!(a.abs_diff(b) < 400, "{layout:?}: {a} {b}");
        }
    }

    #[test]
    fn smaller_planes_are_smaller_and_near() {
        let frame = frame(Layout::LAYERING, 4);
        for (part, num) in Part::ALL.into_iter().zip([4, 1, 5]) {
            let sizes = |divisor| {
                let planes = Layout::Weighted.split(&frame, part, 16, divisor);
                assert_eq!(planes.len(), num);
                [planes[0].width, planes[0].height]
            };
            assert_eq!([sizes(1), sizes(2), sizes(5)], [[48, 40], [24, 20], [10, 8]]);
        }
        let mean_error = |divisors| {
            let (a, b) = (rejoined(Layout::Weighted, &frame, 16, divisors).flatten(), frame.flatten());
            let all = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
            all.map(|(x, y)| (x - y).abs()).sum::<f32>() / (4 * a.pixels.len()) as f32
        };
        // The own pose does not see depth.
        assert!(error(&rejoined(Layout::Weighted, &frame, 16, [1, 1, 4]), &frame) < 0.02);
        // Colours and opacities are blurred, the more the smaller, and stay where they are.
        let [full, half, eighth] = [[1, 1, 1], [2, 2, 1], [8, 8, 1]].map(mean_error);
        assert!(full < half && half < 0.02 && eighth > 2.0 * half, "{full} {half} {eighth}");
    }

    #[test]
    fn what_is_missing_is_continued_and_what_is_there_stays() {
        let size = [9u32, 7];
        let values: Vec<Option<f32>> = (0..63).map(|i| (i % 9 < 3).then_some(0.25)).collect();
        let filled = fill(&values, size);
        assert!(filled.iter().all(|x| (x - 0.25).abs() < 1e-6));
        let values: Vec<Option<f32>> = (0..63).map(|i| (i % 5 == 0).then_some(i as f32)).collect();
        let filled = fill(&values, size);
        assert!(values.iter().zip(&filled).all(|(v, f)| v.is_none_or(|v| v == *f)));
        assert!(filled.iter().any(|f| *f != filled[0]));
        assert_eq!(fill(&[None; 6], [3, 2]), [0.0; 6]);
    }

    #[test]
    fn any_planes_make_a_valid_frame() {
        let header = frame(Layout::LAYERING, 4).header;
        let (width, height) = (header.camera.intrinsics.width, header.camera.intrinsics.height);
        let mut state = 3u32;
        let mut noise = |channels: u8, bits: u8| {
            let samples = (0..width * height * u32::from(channels)).map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> (32 - u32::from(bits))) as u16
            });
            Raster { width, height, channels, bits, samples: samples.collect() }
        };
        for layout in [Layout::Published, Layout::Weighted] {
            let color: Vec<_> = (0..4).map(|_| noise(3, 8)).collect();
            let opacity: Vec<_> = (0..4).map(|_| noise(1, 8)).collect();
            let depth: Vec<_> = (0..5).map(|_| noise(1, 16)).collect();
            let frame = layout.join(header, &color, &opacity, &depth);
            frame.validate().unwrap();
            assert!(frame.num_segments() > 0);
        }
    }
}
