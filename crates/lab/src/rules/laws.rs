//! A law for every rule that it alone obeys: each is held against the lists of all rules, and only those of its own may
//! pass. Lists are looked at before their depths are rounded.

use std::sync::{Arc, Mutex};

use glam::Vec3;

use super::single_depth::{SingleDepth, THRESHOLD_SHARE};
use super::*;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::layering::budget::longest_list;
use isinglass_core::kernels::march::{Advance, MarchSettings, Sink, TRANSMITTANCE_MIN};
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Volume, Voxels};

const K: usize = 8;
/// All but [`Rule::AllSamples`], which stands last.
const RULES: &[Rule] = Rule::ALL.split_at(Rule::ALL.len() - 1).0;

/// One ray, and what a rule made of it.
struct Traced {
    /// Its visible steps, as every rule that marches to the far side sees them.
    steps: Vec<Step>,
    /// The steps that a rendering sees, each with the transmittance in front of it.
    seen: Vec<(Step, f64)>,
    list: Vec<OpenSegment>,
    h: f32,
    s_per_depth: f32,
}

/// Several rays through one scene.
struct Probe {
    name: &'static str,
    rays: Vec<Traced>,
    /// View depths of the box.
    depths: (f32, f32),
    /// Sheets of the ray, as distances from the eye, if it is one of sheets.
    sheets: Vec<f32>,
}

/// Keeps the steps, and the transmittance in front of each.
struct Record {
    steps: Vec<(Step, f64)>,
    transmittance: f32,
    /// Whether to go on behind what a rendering sees.
    goes_on: bool,
}

impl Record {
    fn new(goes_on: bool) -> Self {
        Self { steps: vec![], transmittance: 1.0, goes_on }
    }
}

impl Sink for Record {
    fn step(&mut self, step: Step) -> Advance {
        self.steps.push((step, self.transmittance.into()));
        self.transmittance *= 1.0 - step.alpha;
        match self.goes_on {
            true => Advance::behind(self.transmittance),
            false if self.transmittance > TRANSMITTANCE_MIN => Advance::Step,
            false => Advance::Stop,
        }
    }
}

fn scene(volume: Volume, high: f32, settings: MarchSettings) -> Scene {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    let transfer = TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![
            p(0.1, [0.2, 0.4, 1.0], 0.0),
            p(0.4, [0.3, 0.9, 0.5], high * 0.3),
            p(1.0, [1.0, 0.7, 0.3], high),
        ],
    };
    Scene::new(Arc::new(volume), &transfer, settings)
}

/// Keeps the rays of a rule, or of ours at a threshold.
struct Recorded {
    rule: Rule,
    threshold: f32,
    rays: Mutex<Vec<Traced>>,
}

impl Recorded {
    fn new(rule: Rule, threshold: f32) -> Self {
        Self { rule, threshold, rays: Mutex::default() }
    }

    fn rays(self, scene: &Scene, camera: Camera) -> Vec<Traced> {
        layering::generate_by(scene, FrameHeader::alone(camera, K as u8), &self, ALWAYS).unwrap();
        self.rays.into_inner().unwrap()
    }
}

impl layering::Rule for Recorded {
    fn list<T: Texels>(&self, of: &Listing<'_, T>, k: usize, list: &mut SegmentList) {
        let [mut all, mut seen] = [Record::new(true), Record::new(false)];
        of.march(&mut all);
        of.march(&mut seen);
        match self.rule {
            Rule::VisibilityMerge => of.list(longest_list(k), self.threshold, list),
            rule => layering::Rule::list(&rule, of, k, list),
        }
        if !all.steps.is_empty() {
            let steps = all.steps.iter().map(|s| s.0).collect();
            let (h, s_per_depth) = (of.lattice.h, of.s_per_depth);
            let list = list.segments[..list.len].to_vec();
            self.rays.lock().unwrap().push(Traced { steps, seen: seen.steps, list, h, s_per_depth });
        }
    }
}

/// The least threshold with at most K segments a list.
fn threshold_of_ours(scene: &Scene, camera: Camera) -> f32 {
    let (mut low, mut high) = (-20f32, 20f32);
    for _ in 0..16 {
        let middle = 0.5 * (low + high);
        let rays = Recorded::new(Rule::VisibilityMerge, middle.exp2()).rays(scene, camera);
        let num: usize = rays.iter().map(|ray| ray.list.len()).sum();
        if num <= K * rays.len() { high = middle } else { low = middle }
    }
    high.exp2()
}

fn trace(
    name: &'static str,
    scene: &Scene,
    (width, height): (u32, u32),
    rule: Rule,
    sheets: &[u32],
) -> Probe {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(width, height, 0.6);
    let turn = if sheets.is_empty() { (0.5, 0.3) } else { (0.0, 0.0) };
    let pose = Pose::orbit(bounds.center(), turn.0, turn.1, bounds.radius() * intrinsics.fit_distance());
    let camera = Camera::new(pose, intrinsics, &bounds);
    let is_ours = rule == Rule::VisibilityMerge;
    let threshold = if is_ours { threshold_of_ours(scene, camera) } else { 0.0 };
    let rays = Recorded::new(rule, threshold).rays(scene, camera);
    let corner = |i: u32| {
        let pick =
            |bit: u32, axis: usize| if i >> bit & 1 == 0 { bounds.min[axis] } else { bounds.max[axis] };
        (Vec3::new(pick(0, 0), pick(1, 1), pick(2, 2)) - pose.eye).dot(pose.forward())
    };
    let depths = (0..8).map(corner).fold((f32::MAX, 0f32), |(lo, hi), d| (lo.min(d), hi.max(d)));
    // Looking along −z: the last slice is the nearest.
    let spacing = scene.volume.spacing().z;
    let sheets = sheets.iter().map(|&z| pose.eye.z - bounds.min.z - (z as f32 + 0.5) * spacing).collect();
    Probe { name, rays, depths, sheets }
}

/// One sheet more than K across a ray, all alike, at the given slices from the eye on.
fn sheets(slices: [u32; K + 1]) -> Scene {
    let n = 8 * 8 * 128;
    let voxels = (0..n).map(|i| if slices.contains(&(i / 64)) { 150 } else { 0 }).collect();
    let volume =
        Volume::new([8, 8, 128], Vec3::ONE, Voxels::U8(voxels), (1.0, 0.0), Default::default()).unwrap();
    scene(volume, 0.1, MarchSettings { shading: None, ..Default::default() })
}

/// The nearest two are in front, in the middle, and behind.
const SHEETS: [[u32; K + 1]; 3] = [
    [120, 116, 104, 91, 77, 63, 50, 34, 20],
    [120, 106, 92, 77, 64, 60, 46, 30, 14],
    [121, 106, 92, 78, 64, 50, 36, 20, 16],
];

fn probes(rule: Rule) -> Vec<Probe> {
    let mut probes = vec![];
    for (name, builtin, high) in
        [("cloud", Builtin::Cloud, 0.3), ("cubus", Builtin::Cubus, 0.9), ("shells", Builtin::Shells, 0.4)]
    {
        let scene = scene(builtin.volume(48), high, MarchSettings::default());
        probes.push(trace(name, &scene, (30, 27), rule, &[]));
    }
    probes.extend(SHEETS.map(|slices| trace("sheets", &sheets(slices), (1, 1), rule, &slices)));
    probes
}

impl Traced {
    fn total(&self) -> f32 {
        1.0 - (-self.steps.iter().map(|s| s.tau).sum::<f32>()).exp()
    }

    /// Rounding of a distance, far below a step.
    fn near(&self, a: f32, b: f32) -> bool {
        (a - b).abs() < 0.02 * self.h
    }

    /// One segment without a length; its distance.
    fn single(&self) -> Option<f32> {
        match self.list[..] {
            [s] if s.s0 == s.s1 => Some(s.s0),
            _ => None,
        }
    }
}

/// With one sheet too many, the two that are nearest to each other become one; rays that differ get lists that differ,
/// beyond K too, and no longer than K on average.
fn merges_within_the_frame(probe: &Probe) -> bool {
    if !probe.sheets.is_empty() {
        return merges_the_nearest(probe);
    }
    let lengths = || probe.rays.iter().map(|ray| ray.list.len());
    // Lengths of 1 to 24 spread by about five, so the sample of some fifty rays finds their mean to about one.
    let mean = lengths().sum::<usize>() as f32 / probe.rays.len() as f32;
    lengths().any(|len| len > K) && mean <= K as f32 + 3.0
}

/// With one sheet too many, the two that are nearest to each other become one.
fn merges_the_nearest(probe: &Probe) -> bool {
    let sheets = &probe.sheets;
    let gap = |i: &usize| sheets[i + 1] - sheets[*i];
    let nearest = (0..sheets.len().saturating_sub(1)).min_by(|a, b| gap(a).total_cmp(&gap(b)));
    let Some(nearest) = nearest else { return false };
    probe.rays.iter().all(|ray| {
        let mut first = 0;
        ray.list.len() == K
            && ray.list.iter().all(|s| {
                // A sheet is two voxels thick, being interpolated, and a voxel is one world unit.
                let after = first + if first == nearest { 2 } else { 1 };
                let expected = (sheets[first] - 1.0, sheets[after - 1] + 1.0);
                first = after;
                (s.s0 - expected.0).abs() < 1.0 && (s.s1 - expected.1).abs() < 1.0
            })
    })
}

/// K segments without a gap, each with the K-th part of the opacity.
fn shares_equally(probe: &Probe) -> bool {
    probe.rays.iter().filter(|ray| ray.total() > 0.01).all(|ray| {
        let opacity_total: f32 = 1.0 - ray.list.iter().map(|s| 1.0 - s.alpha).product::<f32>();
        let mut kappa = 1.0;
        ray.list.len() == K
            && ray.list.windows(2).all(|w| ray.near(w[0].s1, w[1].s0))
            && ray.list.iter().all(|s| {
                let share = kappa * s.alpha / opacity_total;
                kappa *= 1.0 - s.alpha;
                // Differences of numbers near one, in single precision.
                (share * K as f32 - 1.0).abs() < 2e-3
            })
    })
}

/// Every segment has the K-th part of the length from the first to the last content, and begins at a multiple of it.
fn has_equal_lengths(probe: &Probe) -> bool {
    probe.rays.iter().all(|ray| {
        let (first, last) = (ray.steps[0].s0, ray.steps[ray.steps.len() - 1].s1);
        let length = (last - first) / K as f32;
        let whole = |x: f32| (x - x.round()).abs() < 1e-2;
        ray.list.first().is_some_and(|s| ray.near(s.s0, first))
            && ray.list.last().is_some_and(|s| ray.near(s.s1, last))
            && ray.list.iter().all(|s| ray.near(s.s1 - s.s0, length) && whole((s.s0 - first) / length))
    })
}

/// Steps are parted where they differ: the least difference of a step from the segment that ends in front of it is not
/// below the greatest from the segment that it is added to. No gap is inside of a segment. (Rays with more pieces than K
/// are left out, as there some must be.) And nearly all rays with enough variation get their number.
fn parts_by_a_threshold(probe: &Probe) -> bool {
    let (mut varied, mut full) = (0, 0);
    let parts = probe.rays.iter().all(|ray| {
        let is_gap = |w: &[Step]| w[1].s0 - w[0].s1 > 0.5 * ray.h;
        if ray.steps.windows(2).filter(|w| is_gap(w)).count() >= K {
            return true;
        }
        let (mut least_parted, mut greatest_added) = (f64::INFINITY, 0f64);
        let mut number = 0;
        let mut open: Option<(f64, Vec3, f64, f64)> = None;
        for (i, step) in ray.steps.iter().enumerate() {
            let begins = ray.list.get(number).is_some_and(|s| ray.near(s.s0, step.s0));
            if let Some((s0, c, kappa, tau)) = open {
                let part = f64::from(step.s1 - step.s0) / (f64::from(step.s0) - s0);
                let own = c * ((1.0 - (-tau * part).exp()) / (1.0 - kappa)) as f32;
                let difference = f64::from((own - step.c).length());
                match (is_gap(&ray.steps[i - 1..=i]), begins) {
                    (true, false) => return false,
                    (true, true) => {}
                    (false, true) => least_parted = least_parted.min(difference),
                    (false, false) => greatest_added = greatest_added.max(difference),
                }
            }
            let (alpha, tau) = (f64::from(step.alpha), f64::from(step.tau));
            match &mut open {
                Some((_, c, kappa, depth)) if !begins => {
                    *c += step.c * *kappa as f32;
                    *kappa *= 1.0 - alpha;
                    *depth += tau;
                }
                _ if begins => {
                    number += 1;
                    open = Some((f64::from(step.s0), step.c, 1.0 - alpha, tau));
                }
                _ => return false,
            }
        }
        let different = ray.steps.windows(2).filter(|w| (w[0].c - w[1].c).length() > 1e-2).count();
        if different > 2 * K {
            varied += 1;
            full += usize::from(ray.list.len() as f32 >= 0.85 * K as f32);
        }
        // Differences of colours of at most one, in single precision.
        number == ray.list.len() && ray.list.len() <= K && least_parted >= greatest_added - 1e-5
    });
    parts && full * 10 >= varied * 9
}

/// Between each two neighbouring planes of the frame, all matter of a ray is one segment, and no segment crosses a plane.
fn lies_between_planes(probe: &Probe) -> bool {
    let (first, last) = probe.depths;
    let plane = |ray: &Traced, i: usize| (first + (last - first) * i as f32 / K as f32) * ray.s_per_depth;
    probe.rays.iter().all(|ray| {
        let expected: Vec<_> = (0..K)
            .filter_map(|i| {
                let (front, back) = (plane(ray, i), plane(ray, i + 1));
                let eps = 0.02 * ray.h;
                let mut inside = ray.steps.iter().filter(|s| s.s1 > front + eps && s.s0 < back - eps);
                let nearest = inside.next()?;
                let farthest = inside.next_back().unwrap_or(nearest);
                Some((nearest.s0.max(front), farthest.s1.min(back)))
            })
            .collect();
        // What is left beside a plane may be too thin to be told from nothing.
        let found: Vec<_> = ray.list.iter().filter(|s| s.s1 - s.s0 > 0.02 * ray.h).collect();
        found.len() == expected.len()
            && found.iter().zip(&expected).all(|(s, e)| ray.near(s.s0, e.0) && ray.near(s.s1, e.1))
    })
}

fn middle(s: &Step) -> f64 {
    f64::from(s.s0 + s.s1) * 0.5
}

/// One segment without a length for each ray, where `place` says that it is.
fn is_single(probe: &Probe, place: impl Fn(&[(Step, f64)], f64, f64) -> bool) -> bool {
    probe
        .rays
        .iter()
        .all(|ray| ray.single().is_some_and(|s| place(&ray.seen, f64::from(s), 0.02 * f64::from(ray.h))))
}

fn added((step, kappa): &(Step, f64)) -> f64 {
    kappa * f64::from(step.alpha)
}

/// Whether the step at `s` has, to a thousandth or two, the greatest `value`.
fn has_greatest(seen: &[(Step, f64)], s: f64, eps: f64, value: impl Fn(&(Step, f64)) -> f64) -> bool {
    let greatest = seen.iter().map(&value).fold(0.0, f64::max);
    seen.iter().any(|x| (middle(&x.0) - s).abs() < eps && value(x) >= greatest * 0.998)
}

fn is_at_the(representative: Representative, seen: &[(Step, f64)], s: f64, eps: f64) -> bool {
    let total: f64 = seen.iter().map(added).sum();
    let (entry, exit) = (f64::from(seen[0].0.s0), f64::from(seen[seen.len() - 1].0.s1));
    let expected = match representative {
        Representative::Mean => seen.iter().map(|x| added(x) * middle(&x.0)).sum::<f64>() / total,
        Representative::Entry => entry,
        Representative::Exit => f64::from(seen[seen.len() - 1].0.s0),
        Representative::Midpoint => 0.5 * (entry + exit),
        Representative::Peak => return has_greatest(seen, s, eps, |x| x.0.alpha.into()),
        Representative::Gradient => return has_greatest(seen, s, eps, added),
        Representative::Threshold => {
            let sought = f64::from(THRESHOLD_SHARE) * total;
            let mut sum = 0.0;
            return seen.iter().any(|x| {
                let before = sum;
                sum += added(x);
                // In single precision the step beside may be the one.
                (middle(&x.0) - s).abs() < eps && before < sought + 1e-5 && sum > sought - 1e-5
            });
        }
    };
    (s - expected).abs() < eps
}

fn obeys(law: Rule, probe: &Probe) -> bool {
    match law {
        Rule::VisibilityMerge => merges_within_the_frame(probe),
        Rule::EqualTransmittance => shares_equally(probe),
        Rule::EqualLength => has_equal_lengths(probe),
        Rule::Homogeneity => parts_by_a_threshold(probe),
        Rule::Slabs => lies_between_planes(probe),
        Rule::SingleDepth(r) => is_single(probe, |seen, s, eps| is_at_the(r, seen, s, eps)),
        Rule::AllSamples => unreachable!("has no list of segments"),
    }
}

#[test]
fn every_rule_obeys_its_own_law_and_no_other_rule_does() {
    for &rule in RULES {
        let probes = probes(rule);
        assert!(probes.iter().all(|p| !p.rays.is_empty()));
        for &law in RULES {
            let broken: Vec<_> = probes.iter().filter(|p| !obeys(law, p)).map(|p| p.name).collect();
            assert_eq!(broken.is_empty(), law == rule, "law of {law}, lists of {rule}: {broken:?}");
        }
    }
}

#[test]
fn representative_depths_have_their_closed_forms() {
    // σ = 4s over 0 ≤ s ≤ 1: κ = e^(−2s²).
    let n = 1000;
    let feed = |sink: &mut SingleDepth| {
        for i in 0..n {
            let (s0, s1) = (i as f32 / n as f32, (i + 1) as f32 / n as f32);
            let tau = 2.0 * (s1 * s1 - s0 * s0);
            sink.step(Step { s0, s1, c: Vec3::splat(opacity(tau)), tau, alpha: opacity(tau) });
        }
    };
    for representative in Representative::ALL {
        let mut sink = SingleDepth::new(f32::INFINITY);
        feed(&mut sink);
        if representative == Representative::Threshold {
            sink = sink.again();
            feed(&mut sink);
        }
        let found = sink.finish(representative).segments[0];
        let expected = match representative {
            // ∫κσs ds/(1 − κ(1)) = (√(π/8)·erf(√2) − e^−2)/(1 − e^−2).
            Representative::Mean => 0.53525,
            Representative::Entry => 0.0,
            Representative::Exit => 0.999,
            Representative::Midpoint => 0.5,
            // σ is greatest at the end.
            Representative::Peak => 1.0,
            // (κσ)' = 0 where σ' = σ².
            Representative::Gradient => 0.5,
            // 1 − κ = 0.8·(1 − e^−2).
            Representative::Threshold => 0.76707,
        };
        // One step; near its flat maximum κσ changes by a thousandth, which counts as equal, over 22 steps.
        let limit = if representative == Representative::Gradient { 0.025 } else { 0.001 };
        assert!((found.s0 - expected).abs() <= limit, "{representative:?}: {}", found.s0);
        assert!((found.tau - 2.0).abs() < 1e-4 && (found.c.x - found.alpha).abs() < 1e-5);
    }
}

#[test]
fn names_are_read_as_they_are_written() {
    for rule in Rule::ALL {
        assert_eq!(rule.to_string().parse(), Ok(rule));
    }
    assert_eq!("single-depth:mean".parse(), Ok(Rule::SingleDepth(Representative::Mean)));
    let error = "single-depth:middle".parse::<Rule>().unwrap_err();
    assert!(error.contains("'single-depth:middle'") && error.contains("single-depth:midpoint"), "{error}");
}
