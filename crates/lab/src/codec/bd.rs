//! The mean difference of two rate-distortion curves, as a share of the rate (Bjøntegaard 2001, VCEG-M33).
//!
//! Quality is Q = −10·log₁₀(DSSIM), in decibels as PSNR is. With r(Q) the decimal logarithm of the bytes that a codec
//! takes for quality Q, and [a, b] what both curves reach,
//!
//!   BD-rate = 10^(1/(b − a) · ∫ₐᵇ (r_test(Q) − r_anchor(Q)) dQ) − 1:
//!
//! −0.3 says that the same picture takes 30 % fewer bytes, on average over that range. Between measured points r is the
//! monotone cubic of Fritsch and Carlson 1980 (slopes of Brodlie's formula), as ITU-T HSTP-VID-WPOM recommends in
//! place of the one polynomial of the original, which can swing between points. Nothing is extrapolated: curves that
//! share no quality have no difference, and are refused.

use serde::Serialize;

/// One measured point of a curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RatePoint {
    pub(crate) bytes: f64,
    /// Distortion, 0 to 1.
    pub(crate) dssim: f64,
}

impl RatePoint {
    /// Decibels; a perfect picture has [`BEST_DB`].
    pub fn quality_db(&self) -> f64 {
        if self.dssim > 0.0 { (-10.0 * self.dssim.log10()).min(BEST_DB) } else { BEST_DB }
    }
}

/// The difference between two curves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BdRate {
    /// Mean excess of the test's bytes over the anchor's, percent.
    pub(crate) percent: f64,
    /// The same only in the middle of the range.
    pub(crate) middle_percent: f64,
    /// Where both curves begin and end, decibels.
    pub(crate) range_db: [f64; 2],
}

/// Why two curves have no mean difference.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BdError {
    /// A curve has too few points.
    #[error("few points: {found} on the front, expected at least {MIN_POINTS}")]
    Points {
        /// Number of points on the front.
        found: usize,
    },
    /// They share hardly any quality.
    #[error("little: {shared:.2} dB are shared, expected at least {LEAST_OVERLAP_DB}")]
    LittleOverlap {
        /// The shared range, decibels.
        shared: f64,
    },
    /// They share no quality. A finer test can still be better, if its least bytes are below the anchor's most.
    #[error("{} everywhere: {:.1} to {:.1} dB from {least:.0} bytes, anchor {:.1} to {:.1} dB up to {most:.0} bytes",
        if test[0] >= anchor[1] { "finer" } else { "coarser" }, test[0], test[1], anchor[0], anchor[1])]
    NoOverlap {
        /// Least and greatest quality of the anchor, decibels.
        anchor: [f64; 2],
        /// Those of the test.
        test: [f64; 2],
        /// Bytes of the test at its least quality.
        least: f64,
        /// Bytes of the anchor at its greatest.
        most: f64,
    },
}

/// Compares two sets of points, in any order. Points that another point of the same set, or a mix of two, beats in
/// both regards do not count.
pub fn bd_rate(anchor: &[RatePoint], test: &[RatePoint]) -> Result<BdRate, BdError> {
    let (anchor, test) = (Curve::new(anchor)?, Curve::new(test)?);
    let (a, b) = (anchor.range(), test.range());
    let range_db = [a[0].max(b[0]), a[1].min(b[1])];
    let shared = range_db[1] - range_db[0];
    if (f64::EPSILON..LEAST_OVERLAP_DB).contains(&shared) {
        return Err(BdError::LittleOverlap { shared });
    }
    if shared < LEAST_OVERLAP_DB {
        let bytes = |log_rate: Option<&f64>| log_rate.map_or(0.0, |r| 10f64.powf(*r));
        let (least, most) = (bytes(test.log_rate.first()), bytes(anchor.log_rate.last()));
        return Err(BdError::NoOverlap { anchor: a, test: b, least, most });
    }
    let mean = (test.integral(range_db) - anchor.integral(range_db)) / (range_db[1] - range_db[0]);
    let middle = 0.5 * (range_db[0] + range_db[1]);
    let [percent, middle_percent] =
        [mean, test.value(middle) - anchor.value(middle)].map(|log| 100.0 * (10f64.powf(log) - 1.0));
    Ok(BdRate { percent, middle_percent, range_db })
}

/// The indices of the points that no other beats in both regards, by bytes.
pub fn front(points: &[RatePoint]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|&i, &j| {
        let (p, q) = (&points[i], &points[j]);
        p.bytes.total_cmp(&q.bytes).then(p.dssim.total_cmp(&q.dssim))
    });
    let mut least = f64::INFINITY;
    order.retain(|&i| {
        let is_better = points[i].dssim < least;
        least = least.min(points[i].dssim);
        is_better
    });
    order
}

/// Of points on the front in the order of their bytes, those that no mix of two others beats: the lower convex hull
/// in bytes and DSSIM. A search over several steps leaves points that cost a third more for a hundredth less; nobody
/// would choose them, and a curve through them is worse than its codec.
fn hull(points: Vec<RatePoint>) -> Vec<RatePoint> {
    let mut hull: Vec<RatePoint> = Vec::with_capacity(points.len());
    for point in points {
        while let [.., a, b] = hull[..] {
            // Height of the straight line from a to the point, relative to b.
            let share = (b.bytes - a.bytes) / (point.bytes - a.bytes);
            if a.dssim + share * (point.dssim - a.dssim) > b.dssim {
                break;
            }
            hull.pop();
        }
        hull.push(point);
    }
    hull
}

/// Logarithm of the rate over quality.
struct Curve {
    quality: Vec<f64>,
    log_rate: Vec<f64>,
    slope: Vec<f64>,
}

impl Curve {
    fn new(points: &[RatePoint]) -> Result<Self, BdError> {
        let points = hull(front(points).into_iter().map(|i| points[i]).collect());
        // Perfect pictures have the same quality; the cheapest is kept.
        let quality: Vec<f64> = points.iter().map(RatePoint::quality_db).collect();
        let num = quality.windows(2).take_while(|w| w[1] > w[0]).count() + usize::from(!quality.is_empty());
        if num < MIN_POINTS {
            return Err(BdError::Points { found: num });
        }
        let quality = quality[..num].to_vec();
        let log_rate: Vec<f64> = points[..num].iter().map(|p| p.bytes.max(1.0).log10()).collect();
        let slope = monotone_slopes(&quality, &log_rate);
        Ok(Self { quality, log_rate, slope })
    }

    fn range(&self) -> [f64; 2] {
        [self.quality[0], self.quality[self.quality.len() - 1]]
    }

    /// Integral of the logarithm of the rate over `range`, which lies inside the curve's.
    fn integral(&self, range: [f64; 2]) -> f64 {
        (0..self.quality.len() - 1)
            .map(|i| {
                let (a, b) = (range[0].max(self.quality[i]), range[1].min(self.quality[i + 1]));
                // Simpson's rule has no error on a cubic.
                let sum = self.at(i, a) + 4.0 * self.at(i, 0.5 * (a + b)) + self.at(i, b);
                if b > a { (b - a) / 6.0 * sum } else { 0.0 }
            })
            .sum()
    }

    /// The logarithm of the rate at a quality inside the curve's.
    fn value(&self, quality: f64) -> f64 {
        let behind = self.quality.partition_point(|&q| q <= quality);
        self.at(behind.clamp(1, self.quality.len() - 1) - 1, quality)
    }

    /// The cubic of piece `i`.
    fn at(&self, i: usize, quality: f64) -> f64 {
        let h = self.quality[i + 1] - self.quality[i];
        let t = (quality - self.quality[i]) / h;
        let (y0, y1) = (self.log_rate[i], self.log_rate[i + 1]);
        let (d0, d1) = (self.slope[i] * h, self.slope[i + 1] * h);
        let (t2, t3) = (t * t, t * t * t);
        y0 * (2.0 * t3 - 3.0 * t2 + 1.0)
            + d0 * (t3 - 2.0 * t2 + t)
            + y1 * (3.0 * t2 - 2.0 * t3)
            + d1 * (t3 - t2)
    }
}

/// Slopes at the points with which no piece overshoots: weighted harmonic means of the chords at both sides; at the
/// ends the chord itself.
fn monotone_slopes(x: &[f64], y: &[f64]) -> Vec<f64> {
    let step: Vec<f64> = x.windows(2).map(|w| w[1] - w[0]).collect();
    let chord: Vec<f64> = y.windows(2).zip(&step).map(|(w, h)| (w[1] - w[0]) / h).collect();
    (0..x.len())
        .map(|i| {
            if i == 0 {
                return chord[0];
            }
            if i == x.len() - 1 {
                return chord[i - 1];
            }
            if chord[i - 1] * chord[i] <= 0.0 {
                return 0.0;
            }
            let (w0, w1) = (2.0 * step[i] + step[i - 1], step[i] + 2.0 * step[i - 1]);
            (w0 + w1) / (w0 / chord[i - 1] + w1 / chord[i])
        })
        .collect()
}

/// Quality of a perfect picture: below a millionth DSSIM is rounding.
pub const BEST_DB: f64 = 60.0;
/// Fewest points of a curve.
pub const MIN_POINTS: usize = 3;
/// Shared range below which curves say nothing.
pub const LEAST_OVERLAP_DB: f64 = 0.5;

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(bytes_of_db: impl Fn(f64) -> f64, db: &[f64]) -> Vec<RatePoint> {
        db.iter().map(|&q| RatePoint { bytes: bytes_of_db(q), dssim: 10f64.powf(-q / 10.0) }).collect()
    }

    const DB: [f64; 6] = [18.0, 20.5, 22.0, 25.0, 28.0, 31.0];

    #[test]
    fn a_constant_share_of_the_rate_is_that_share_wherever_the_points_lie() {
        let anchor = curve(|q| 1e3 * 1.2f64.powf(q), &DB);
        for share in [0.3, 0.5, 1.0, 2.5] {
            // Straight in these scales, so other points of it are on the same curve.
            let test = curve(|q| share * 1e3 * 1.2f64.powf(q), &[17.0, 19.0, 24.0, 26.5, 33.0]);
            let bd = bd_rate(&anchor, &test).unwrap();
            // Logarithms and powers of doubles.
            for percent in [bd.percent, bd.middle_percent] {
                assert!((percent - 100.0 * (share - 1.0)).abs() < 1e-9, "{share}: {percent}");
            }
            assert!((bd.range_db[0] - 18.0).abs() < 1e-9 && (bd.range_db[1] - 31.0).abs() < 1e-9);
        }
        let other = curve(|q| 0.5e3 * 1.3f64.powf(q), &DB);
        assert!((bd_rate(&anchor, &other).unwrap().percent + 50.0).abs() > 10.0, "another slope shows");
    }

    #[test]
    fn a_known_integral_is_found() {
        // log10 rate 2 + q/10 against 2 + q²/200: over 10 to 20 dB the mean of the difference is
        // (7000/3)/200/10 − 1.5 = −1/3. Points at every tenth of a decibel leave the cubics no room.
        let db: Vec<f64> = (0..=100).map(|i| 10.0 + 0.1 * f64::from(i)).collect();
        let anchor = curve(|q| 10f64.powf(2.0 + q / 10.0), &db);
        let test = curve(|q| 10f64.powf(2.0 + q * q / 200.0), &db);
        let expected = 100.0 * (10f64.powf(-1.0 / 3.0) - 1.0);
        let BdRate { percent, middle_percent, .. } = bd_rate(&anchor, &test).unwrap();
        // At 15 dB, a point of both: 1.125 − 1.5.
        assert!((middle_percent - 100.0 * (10f64.powf(-0.375) - 1.0)).abs() < 1e-9, "{middle_percent}");
        // Chords as the slopes at both ends are off by h/200 each: an error of h²/1200 over h, of 10 dB: 2e-8 in all.
        assert!((percent - expected).abs() < 1e-3, "{percent} {expected}");
        // The reverse comparison is the reverse ratio.
        let back = bd_rate(&test, &anchor).unwrap().percent;
        assert!(((1.0 + percent / 100.0) * (1.0 + back / 100.0) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn points_that_others_beat_change_nothing_and_order_does_not_matter() {
        let anchor = curve(|q| 1e3 * 1.2f64.powf(q), &DB);
        let mut test = curve(|q| 700.0 * 1.2f64.powf(q), &DB);
        let alone = bd_rate(&anchor, &test).unwrap();
        test.push(RatePoint { bytes: 1e9, dssim: 10f64.powf(-2.5) });
        test.reverse();
        assert_eq!(bd_rate(&anchor, &test), Ok(alone));
        test.push(RatePoint { bytes: 10.0, dssim: 10f64.powf(-2.5) });
        assert!(bd_rate(&anchor, &test).unwrap().percent < alone.percent);
    }

    #[test]
    fn points_that_a_mix_of_two_others_beats_change_nothing() {
        let anchor = curve(|q| 1e3 * 1.2f64.powf(q), &DB);
        let mut test = curve(|q| 700.0 * 1.2f64.powf(q), &DB);
        let alone = bd_rate(&anchor, &test).unwrap();
        // Between 22 and 25 dB: a tenth of the way in DSSIM for nine tenths of the bytes, and the other way round.
        let between = |of_bytes: f64, of_dssim: f64| {
            let [a, b] = [test[2], test[3]];
            RatePoint {
                bytes: a.bytes + of_bytes * (b.bytes - a.bytes),
                dssim: a.dssim + of_dssim * (b.dssim - a.dssim),
            }
        };
        let (dear, good) = (between(0.9, 0.1), between(0.1, 0.9));
        test.push(dear);
        assert_eq!(front(&test).len(), 7, "no single other beats it");
        assert_eq!(bd_rate(&anchor, &test), Ok(alone));
        test.push(good);
        assert!(bd_rate(&anchor, &test).unwrap().percent < alone.percent);
    }

    #[test]
    fn what_shares_no_quality_is_refused() {
        let low = curve(|q| 1e3 * 1.2f64.powf(q), &[10.0, 12.0, 14.0]);
        let high = curve(|q| 1e3 * 1.2f64.powf(q), &[15.0, 20.0, 25.0]);
        let refused = bd_rate(&low, &high).unwrap_err();
        assert!(matches!(refused, BdError::NoOverlap { .. }));
        assert!(refused.to_string().contains("finer everywhere"), "{refused}");
        let barely = curve(|q| 1e3 * 1.2f64.powf(q), &[13.8, 16.0, 20.0]);
        let refused = bd_rate(&low, &barely).unwrap_err();
        assert!(
            matches!(refused, BdError::LittleOverlap { .. }) && refused.to_string().contains("0.20 dB"),
            "{refused}"
        );
        assert!(bd_rate(&high, &low).unwrap_err().to_string().contains("coarser everywhere"));
        assert_eq!(bd_rate(&low, &high[..1]), Err(BdError::Points { found: 1 }));
        assert_eq!(bd_rate(&[], &high), Err(BdError::Points { found: 0 }));
        // Perfect pictures are one point.
        let perfect = [1.0, 2.0, 3.0].map(|bytes| RatePoint { bytes, dssim: 0.0 });
        assert_eq!(bd_rate(&low, &perfect), Err(BdError::Points { found: 1 }));
    }
}
