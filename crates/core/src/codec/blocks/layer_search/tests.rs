use glam::Vec3;

use super::*;
use crate::camera::{Camera, Intrinsics, Pose};
use crate::layer::{FrameHeader, LayeredFrame, Over, Segment};
use crate::simd::tests::with_each;
use crate::space::Aabb;

/// A frame of one block with these lists.
pub(in crate::codec::blocks) fn frame(list: impl Fn(usize) -> Vec<Segment>) -> LayeredFrame {
    let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::ONE };
    let intrinsics = Intrinsics::perspective(BLOCK as u32, BLOCK as u32, 0.7);
    let pose = Pose::orbit(Vec3::ZERO, 0.5, 0.3, 4.0);
    let camera = Camera::new(pose, intrinsics, &bounds);
    let header = FrameHeader::alone(camera, MAX_LAYERS as u8);
    let mut frame = LayeredFrame::empty(header);
    for i in 0..BLOCK_LISTS {
        for segment in list(i) {
            frame.push(&segment);
        }
        frame.offsets[i + 1] = frame.num_segments() as u32;
    }
    frame.validate().unwrap();
    frame
}

fn segment(front: f32, back: f32, gray: f32, tau: f32) -> Segment {
    let alpha = 1.0 - (-tau).exp();
    Segment { front: front as u16, back: back as u16, c: Vec3::new(gray, 0.5 * gray, 0.2) * alpha, tau }
}

fn lists(frame: &LayeredFrame) -> BlockLists {
    let mut lists = BlockLists::default();
    lists.read(frame, 0, 0);
    lists
}

/// A sloping slab, thicker than thin.
pub(in crate::codec::blocks) fn slab(i: usize, z: f32, thickness: f32, gray: f32, tau: f32) -> Segment {
    let front = PlaneFit { z, dx: 90.0, dy: -60.0 }.at(i);
    segment(front, front + thickness, gray, tau)
}

/// Lists as no surface makes them.
fn rough(i: usize) -> Vec<Segment> {
    let mut state = i as u32 * 7919 + 17;
    let mut random = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let mut at = 9000.0 + 3000.0 * random();
    let mut list = vec![];
    for _ in 0..(16.0 * random()) as usize {
        let front = at + (3000.0 * random() - 1000.0).max(0.0);
        at = (front + 1.0 + 2500.0 * random()).ceil();
        list.push(segment(front, at, random(), 3.0 * random() * random()));
    }
    list
}

pub(in crate::codec::blocks) const COST: LayerCost = LayerCost { lambda: 0.1, units_per_pixel: 130.0 };

fn composite_of_list(frame: &LayeredFrame, i: usize) -> [f32; 4] {
    let mut over = Over::default();
    for index in frame.list(i) {
        let segment = frame.segment(index);
        over.add(segment.c, segment.tau);
    }
    over.rgba()
}

fn composite_of_layers(layers: &[BlockLayer], i: usize) -> [f32; 4] {
    let mut over = Over::default();
    for layer in layers {
        over.add(layer.c[i], layer.tau[i]);
    }
    over.rgba()
}

fn greatest_change(frame: &LayeredFrame, layers: &[BlockLayer]) -> f32 {
    let change = |i| {
        let (a, b) = (composite_of_list(frame, i), composite_of_layers(layers, i));
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    (0..BLOCK_LISTS).map(change).fold(0.0, f32::max)
}

fn planes(layers: &[BlockLayer]) -> Vec<(PlaneFit, PlaneFit)> {
    layers.iter().map(|layer| (layer.front, layer.back)).collect()
}

/// Finds layers and puts the lists into them. Returns the error.
fn find(search: &mut LayerSearch, lists: &BlockLists, cost: &LayerCost, out: &mut Vec<BlockLayer>) -> f32 {
    let mut planes = vec![];
    search.find(lists, cost, &mut planes);
    assign(search, lists, &planes, out)
}

/// Puts lists between planes. Returns the error, of all lists.
fn assign(
    search: &mut LayerSearch,
    lists: &BlockLists,
    planes: &[(PlaneFit, PlaneFit)],
    out: &mut Vec<BlockLayer>,
) -> f32 {
    search.assign(lists, planes, out);
    moved::moved(&mut search.walk, lists, planes, &AllLists, 1.0, f32::INFINITY)
}

#[test]
fn matter_is_conserved() {
    let frame = frame(rough);
    let lists = lists(&frame);
    let (mut search, mut layers) = (LayerSearch::default(), vec![]);
    for lambda in [0.0, 0.1, 10.0, 1e9] {
        find(&mut search, &lists, &LayerCost { lambda, ..COST }, &mut layers);
        // Up to 16 segments and 24 layers of numbers to 1, each rounded a few times to 2^−24; a segment thinner than
        // `TAU_MIN` is made as thick, which takes up to 10^−4 of what is behind it. There is at most one in a list.
        assert!(greatest_change(&frame, &layers) < 1.1e-4, "{lambda}");
        let fresh_planes = planes(&layers);
        search.assign(&lists, &fresh_planes, &mut layers);
        assert!(greatest_change(&frame, &layers) < 1.1e-4, "{lambda}");
    }
    // Planes that have nothing to do with the lists, and not in order.
    let plane = |z, dx| PlaneFit { z, dx, dy: 30.0 };
    let foreign = [
        (plane(20000.0, 0.0), plane(14000.0, 200.0)),
        (plane(11000.0, -900.0), plane(15000.0, 0.0)),
        (plane(16000.0, 0.0), plane(16100.0, 10.0)),
    ];
    search.assign(&lists, &foreign, &mut layers);
    assert!(greatest_change(&frame, &layers) < 1.1e-4);
    assert_eq!(layers.len(), foreign.len());
    // Something taken away is noticed.
    let layer = &mut layers[0];
    layer.c[layer.mask.trailing_zeros() as usize] *= 0.9;
    assert!(greatest_change(&frame, &layers) > 1e-3);
}

/// Behind so much that what is seen of them is less than the rounding of what is seen in front.
#[test]
fn what_is_hidden_keeps_its_colour() {
    let flat = |z| PlaneFit { z, dx: 0.0, dy: 0.0 };
    let hidden = [segment(21000.0, 21400.0, 0.9, 0.4), segment(21500.0, 21900.0, 0.2, 0.7)];
    for tau_in_front in [0.0, 2.0, 9.0, 14.0] {
        let front = (tau_in_front > 0.0).then(|| segment(20000.0, 20500.0, 0.6, tau_in_front));
        let frame = frame(|_| front.into_iter().chain(hidden).collect());
        let (mut search, mut layers) = (LayerSearch::default(), vec![]);
        let planes = [(flat(20000.0), flat(20500.0)), (flat(21000.0), flat(21900.0))];
        search.assign(&lists(&frame), &planes, &mut layers);
        let first = usize::from(front.is_some());
        let mut over = Over::default();
        for segment in frame.list(0).skip(first).map(|index| frame.segment(index)) {
            over.add(segment.c, segment.tau);
        }
        let found = composite_of_layers(&layers[1..], 0);
        for (found, wanted) in found.iter().zip(over.rgba()) {
            assert!((found - wanted).abs() < 2e-3 * wanted, "{tau_in_front}: {found} {wanted}");
        }
        // As seen behind τ = 14 the colour is but rounding: the law would not hold of a difference.
        let kappa = (-tau_in_front).exp();
        let seen = (0.6 + kappa * over.rgba()[0]) - 0.6;
        assert_eq!((seen / kappa / over.rgba()[0] - 1.0).abs() > 2e-3, tau_in_front > 10.0);
    }
}

#[test]
fn the_mask_says_where_matter_is() {
    let lists = lists(&frame(rough));
    let (mut search, mut layers) = (LayerSearch::default(), vec![]);
    find(&mut search, &lists, &COST, &mut layers);
    assert!((2..=MAX_LAYERS).contains(&layers.len()));
    for layer in &layers {
        assert_ne!(layer.mask, 0);
        for i in 0..BLOCK_LISTS {
            assert_eq!(layer.mask >> i & 1 == 1, layer.tau[i] > 0.0);
            assert!(layer.tau[i] > 0.0 || layer.c[i] == Vec3::ZERO);
        }
    }
}

#[test]
fn a_slab_is_one_layer_with_its_planes() {
    let mut lists = lists(&frame(|i| vec![slab(i, 20000.0, 3000.0, 0.8, 1.5)]));
    let (mut search, mut layers) = (LayerSearch::default(), vec![]);
    let error = find(&mut search, &lists, &COST, &mut layers);
    assert_eq!((layers.len(), layers[0].mask), (1, u64::MAX));
    let expected = PlaneFit { z: 20000.0, dx: 90.0, dy: -60.0 };
    for (plane, z) in [(layers[0].front, 20000.0), (layers[0].back, 23000.0)] {
        // The slopes are whole numbers, the depth at each list is rounded down by 0 or ½.
        assert!((plane.z - z).abs() < 1.0, "{plane:?}");
        assert!((plane.dx - expected.dx).abs() < 0.5 && (plane.dy - expected.dy).abs() < 0.5, "{plane:?}");
    }
    // Ends are at most a unit from their planes, in 64 lists of opacity 1 − e^−1.5 and slope below 1.
    assert!(error < 64.0 * 1.5 * power_5_4(1.0), "{error}");
    // Nothing has no layers.
    lists.read(&frame(|_| vec![]), 0, 0);
    assert!(lists.is_empty());
    assert_eq!(find(&mut search, &lists, &COST, &mut layers), 0.0);
    assert_eq!(layers, vec![]);
}

#[test]
fn two_slabs_are_two_layers_until_a_layer_is_dear() {
    let lists = lists(&frame(|i| vec![slab(i, 20000.0, 500.0, 0.8, 0.7), slab(i, 24000.0, 700.0, 0.3, 0.9)]));
    let (mut search, mut layers) = (LayerSearch::default(), vec![]);
    let error = find(&mut search, &lists, &COST, &mut layers);
    assert_eq!(layers.len(), 2);
    for (layer, tau) in layers.iter().zip([0.7, 0.9]) {
        assert_eq!(layer.mask, u64::MAX);
        // As a half float.
        assert!(layer.tau.iter().all(|t| (t - tau).abs() < 1e-3));
    }
    assert!(layers[0].back.z < layers[1].front.z);
    let dear = find(&mut search, &lists, &LayerCost { lambda: 1000.0, ..COST }, &mut layers);
    assert_eq!(layers.len(), 1);
    assert!(dear > 100.0 * error, "{dear} {error}");
}

#[test]
fn a_slab_without_a_gap_is_split_where_its_density_changes() {
    let list = |gray| move |i| vec![slab(i, 20000.0, 2000.0, 0.8, 0.3), slab(i, 22000.0, 2000.0, gray, 0.3)];
    let (mut search, mut layers) = (LayerSearch::default(), vec![]);
    find(&mut search, &lists(&frame(list(0.8))), &COST, &mut layers);
    assert_eq!(layers.len(), 1);
    find(&mut search, &lists(&frame(list(0.1))), &COST, &mut layers);
    assert_eq!(layers.len(), 2);
    assert!((layers[0].back.z - 22000.0).abs() < 1.0 && (layers[1].front.z - 22000.0).abs() < 1.0);
}

#[test]
fn errors_of_given_planes_are_those_of_fresh_ones_and_grow_with_distance() {
    let lists = lists(&frame(|i| vec![slab(i, 20000.0, 500.0, 0.8, 0.7), slab(i, 24000.0, 700.0, 0.3, 0.9)]));
    let (mut search, mut layers, mut again) = (LayerSearch::default(), vec![], vec![]);
    let fresh = find(&mut search, &lists, &COST, &mut layers);
    let mut planes = planes(&layers);
    assert_eq!(assign(&mut search, &lists, &planes, &mut again), fresh);
    assert_eq!(layers, again);
    let mut last = fresh;
    for _ in 0..3 {
        for (front, back) in &mut planes {
            front.z += 100.0;
            back.z += 100.0;
        }
        let error = assign(&mut search, &lists, &planes, &mut again);
        assert!(error > 2.0 * last || last > fresh && error > last, "{error} {last}");
        last = error;
    }
    // The planes of the first slab alone.
    assert!(assign(&mut search, &lists, &planes[..1], &mut again) > last);
    assert_eq!(again[0].mask, u64::MAX);
    // Without planes there is no place for anything.
    search.assign(&lists, &[], &mut again);
    assert_eq!(again, vec![]);
}

#[test]
fn planes_that_were_near_are_fitted_to_the_slabs() {
    let two =
        |z: f32| frame(move |i| vec![slab(i, z, 500.0, 0.8, 0.7), slab(i, z + 4000.0, 700.0, 0.3, 0.9)]);
    let (mut search, mut layers) = (LayerSearch::default(), vec![]);
    find(&mut search, &lists(&two(20000.0)), &COST, &mut layers);
    // Where the slabs have moved to, and a layer in front that has nothing any more.
    let moved = lists(&two(20300.0));
    let mut fitted = planes(&layers);
    let nothing = PlaneFit { z: 5000.0, dx: 0.0, dy: 0.0 };
    fitted.insert(0, (nothing, nothing));
    let before = search.error(&moved, &fitted, f32::INFINITY);
    search.fit(&moved, &mut fitted);
    let mut fresh = vec![];
    search.find(&moved, &COST, &mut fresh);
    assert_eq!((fitted.len(), fresh.len()), (2, 2));
    let errors = [&fitted, &fresh].map(|planes| search.error(&moved, planes, f32::INFINITY));
    assert!(errors[0] <= 1.01 * errors[1] && before > 50.0 * errors[0], "{before} {errors:?}");
    // Of a slab that is new a part is in each layer: fitting adds none, which costs more than the layer is worth.
    let three = |i| vec![slab(i, 20300.0, 500.0, 0.8, 0.7), slab(i, 22300.0, 700.0, 0.1, 0.9)];
    let three = lists(&frame(|i| [three(i), vec![slab(i, 24300.0, 700.0, 0.3, 0.9)]].concat()));
    search.fit(&three, &mut fitted);
    search.find(&three, &COST, &mut fresh);
    assert_eq!((fitted.len(), fresh.len()), (2, 3));
    let [fitted, fresh] = [&fitted, &fresh].map(|planes| search.error(&three, planes, f32::INFINITY));
    assert!(fitted > fresh + COST.error_per_layer(), "{fitted} {fresh}");
    // Without planes there is nothing to fit.
    let mut none = vec![];
    search.fit(&moved, &mut none);
    assert_eq!(none, vec![]);
}

#[test]
fn trials_are_near_to_what_is_given_and_end_early() {
    let lists = lists(&frame(rough));
    let (mut search, mut layers, mut planes) = (LayerSearch::default(), vec![], vec![]);
    search.find(&lists, &COST, &mut planes);
    let given = assign(&mut search, &lists, &planes, &mut layers);
    let tried = search.error(&lists, &planes, f32::INFINITY);
    // A quarter of lists without order: the sum of 16 errors that differ by their own size is off by 1/√16, less
    // than half as much again is allowed.
    assert!((tried / given - 1.0).abs() < 0.36, "{tried} {given}");
    assert_eq!(search.error(&lists, &planes, tried), tried);
    assert_eq!(search.error(&lists, &planes, tried * 0.99), f32::INFINITY);
    assert_eq!(search.error(&lists, &[], f32::INFINITY), f32::INFINITY);
    for (front, _) in &mut planes {
        front.z += 2000.0;
    }
    assert!(search.error(&lists, &planes, f32::INFINITY) > 1.5 * tried);
}

#[test]
fn short_ends_stay_with_the_rest() {
    let mut lists = lists(&frame(|_| vec![segment(20000.0, 21000.0, 0.8, 0.7)]));
    let (mut search, mut layers) = (LayerSearch::default(), vec![]);
    let flat = |z| PlaneFit { z, dx: 0.0, dy: 0.0 };
    for (cut, in_first, in_second) in
        [(20095.0, false, true), (20105.0, true, true), (20895.0, true, true), (20905.0, true, false)]
    {
        let planes = [(flat(20000.0), flat(cut)), (flat(cut), flat(21000.0))];
        search.assign(&lists, &planes, &mut layers);
        assert_eq!(layers.iter().map(|l| l.mask != 0).collect::<Vec<_>>(), [in_first, in_second], "{cut}");
    }
    // A block at the edge has empty lists outside.
    lists.read(&frame(rough), 1, 0);
    assert!(lists.is_empty());
}

#[test]
fn layers_are_the_same_with_wider_instructions() {
    let frame = frame(rough);
    let mut search = LayerSearch::default();
    let [portable, avx2, avx512] = with_each(|| {
        let mut layers = vec![];
        let lists = lists(&frame);
        let error = find(&mut search, &lists, &COST, &mut layers);
        let mut fitted: Vec<_> = planes(&layers).into_iter().step_by(2).collect();
        search.fit(&lists, &mut fitted);
        (error, layers, fitted)
    });
    // Nothing is fused or reordered, so the bits are the same.
    assert_eq!(avx2, portable);
    assert_eq!(avx512, portable);
}

#[test]
fn fourth_roots_are_near() {
    for i in 0..200 {
        let x = 1e-3 * 1.1f32.powi(i);
        let ratio = fourth_root(x) / x.sqrt().sqrt();
        assert!((0.96..1.04).contains(&ratio), "{x} {ratio}");
    }
    assert_eq!(power_5_4(0.0), 0.0);
}

#[test]
fn a_single_list_has_its_layers() {
    // Wherever it lies.
    for only in [0, 1, 9, 63] {
        let slabs = |i| vec![slab(i, 20000.0, 500.0, 0.8, 0.7), slab(i, 24000.0, 700.0, 0.3, 0.9)];
        let frame = frame(|i| if i == only { slabs(i) } else { vec![] });
        let (mut search, mut layers) = (LayerSearch::default(), vec![]);
        // One list of 64 weighs as much.
        find(&mut search, &lists(&frame), &LayerCost { lambda: COST.lambda / 64.0, ..COST }, &mut layers);
        assert_eq!(layers.iter().map(|layer| layer.mask).collect::<Vec<_>>(), [1 << only; 2]);
        assert!(greatest_change(&frame, &layers) < 1e-6);
    }
}
