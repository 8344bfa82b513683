use super::*;

const LISTS: usize = 1 << 16;

fn quality(coding: Coding) -> Option<u8> {
    match coding {
        Coding::Blocks(settings) => Some(settings.quality),
        Coding::Exact => None,
    }
}

/// A link of so many bytes a second. Its rate is measured once frames have filled it.
struct FakeLink {
    bytes_per_second: f64,
    queued: f64,
    sent_per_second: f64,
    is_measured: bool,
}

impl FakeLink {
    fn new(megabytes: f64) -> Self {
        let rate = megabytes * 1e6;
        Self { bytes_per_second: rate, queued: 0.0, sent_per_second: 38_400.0 * 10.0, is_measured: false }
    }

    /// 33 ms in which `bytes` are handed over, and what the transport knows then.
    fn send(&mut self, bytes: f64) -> LinkState {
        self.queued = (self.queued + bytes - self.bytes_per_second / 30.0).max(0.0);
        self.is_measured |= self.queued > 0.0;
        self.sent_per_second = self.sent_per_second.max(bytes * 30.0).min(self.bytes_per_second);
        let bytes_per_second = if self.is_measured { self.bytes_per_second } else { self.sent_per_second };
        LinkState { bytes_per_second, is_measured: self.is_measured, least_rtt_micros: 100_000 }
    }
}

/// Bytes of a frame of a quality: what the codec does, with a slope of its own.
fn bytes_at(quality: u8, hardness: f64) -> f64 {
    hardness * 4_000.0 * (f64::from(quality) * 0.033).exp2()
}

#[test]
fn frames_are_made_for_the_turn_they_are_seen_at() {
    let mut control = CodingControl::new(CodingPlan { mode: CodingMode::Blocks, ..CodingPlan::default() });
    let mut next = |turned| {
        control.handle_turned(turned);
        let Coding::Blocks(settings) = control.next(LISTS, true) else { panic!("not in blocks") };
        settings.turn_deg
    };
    assert_eq!(next(None), None);
    assert_eq!([next(Some(4)), next(Some(12)), next(Some(12))], [Some(2), Some(3), Some(4)]);
    // One at rest is made for all, and says nothing of the next movement.
    assert_eq!([next(None), next(Some(12)), next(Some(0))], [None, Some(4), Some(3)]);
    // A jump to another view is forgotten like any turn: twice the half of 20 degrees is the most.
    assert_eq!([next(Some(180)), next(Some(180)), next(Some(180))], [Some(5), Some(6), Some(7)]);
    for _ in 0..8 {
        next(Some(0));
    }
    assert_eq!(next(Some(0)), Some(1));
    // Where it rests, it is made once more for any turn, though it be at the best quality, and never worse.
    let sent =
        |turn_deg| Coding::Blocks(blocks::Settings { turn_deg, ..blocks::Settings::of(DEFAULT_QUALITY) });
    assert_eq!(control.finer(LISTS, &sent(Some(5))), Some(sent(None)));
    assert_eq!(control.finer(LISTS, &sent(None)), None);
    let plan = CodingPlan { mode: CodingMode::Blocks, quality: 0, ..CodingPlan::default() };
    let moving = blocks::Settings { turn_deg: Some(5), ..blocks::Settings::of(LEAST_QUALITY) };
    let finer = CodingControl::new(plan).finer(LISTS, &Coding::Blocks(moving));
    assert_eq!(finer.and_then(quality), Some(LEAST_QUALITY));
}

#[test]
fn frames_fit_the_link_and_come_back_after_a_harder_scene() {
    for megabytes in [0.6, 1.25, 6.0] {
        let mut link = FakeLink::new(megabytes);
        let mut control =
            CodingControl::new(CodingPlan { mode: CodingMode::Blocks, quality: 90, bytes_per_second: None });
        let mut waits = vec![];
        for n in 0..300 {
            // A harder scene from the 150th frame on.
            let hardness = if n < 150 { 1.0 } else { 1.6 };
            let coding = control.next(LISTS, n > 0);
            let bytes = bytes_at(quality(coding).unwrap(), hardness);
            control.handle_encoded(&coding, n > 0, LISTS, bytes as usize, 10_000);
            control.handle_link(link.send(bytes));
            waits.push(link.queued / link.bytes_per_second);
        }
        // Half a second to settle, each time; then what queues is a few frames' worth.
        let calm = waits[15..150].iter().chain(&waits[165..]).fold(0f64, |a, &b| a.max(b));
        assert!(calm < 0.1, "{megabytes}: {calm} s of queue");
        let best = control.bytes_per_second();
        assert!(best > megabytes * 0.5e6, "{megabytes}: {best} of the link is used");
        // The control: a fixed quality fills the narrow link's queue.
        let mut link = FakeLink::new(megabytes);
        for _ in 0..300 {
            link.send(bytes_at(90, 1.0));
        }
        assert_eq!(link.queued > 0.1 * link.bytes_per_second, megabytes < 0.7, "{megabytes}");
    }
}

#[test]
fn a_quality_that_takes_too_long_to_encode_is_left_out() {
    let wide = LinkState { bytes_per_second: 1e11, is_measured: true, least_rtt_micros: 1000 };
    let settled = |generate_micros: u64, micros_at_best: f64| {
        let mut control =
            CodingControl::new(CodingPlan { mode: CodingMode::Blocks, ..CodingPlan::default() });
        let (mut last, mut micros) = (0, 0.0);
        for n in 0..60 {
            control.handle_generated(generate_micros);
            control.handle_link(wide);
            let coding = control.next(LISTS, n > 0);
            last = quality(coding).unwrap();
            // Half the time with every 30 less.
            micros = micros_at_best * ((f64::from(last) - 100.0) / 30.0).exp2();
            control.handle_encoded(&coding, n > 0, LISTS, 1000, micros as u64);
        }
        (last, micros)
    };
    let (quality, micros) = settled(2_000, 90_000.0);
    assert!(quality < 75 && (micros / CODING_MICROS - 1.0).abs() < 0.1, "{quality}: {micros} µs");
    // Where generating takes as long, nothing waits for the coder; and a fast coder makes the best.
    assert_eq!([settled(100_000, 90_000.0).0, settled(2_000, 30_000.0).0], [100, 100]);
    // However slow the coder, the picture stays one.
    assert_eq!(settled(2_000, 1e6).0, LEAST_TIMELY_QUALITY as u8);
}

#[test]
fn a_rate_is_kept_whatever_the_link_carries() {
    let plan = CodingPlan { mode: CodingMode::Blocks, quality: 100, bytes_per_second: Some(1e6) };
    let mut control = CodingControl::new(plan);
    let wide = LinkState { bytes_per_second: 1e10, is_measured: true, least_rtt_micros: 1000 };
    let mut last = 0.0;
    for n in 0..20 {
        control.handle_link(wide);
        let coding = control.next(LISTS, n > 0);
        last = bytes_at(quality(coding).unwrap(), 1.0);
        control.handle_encoded(&coding, n > 0, LISTS, last as usize, 1000);
    }
    assert!((20_000.0..=33_400.0).contains(&last), "{last} bytes a frame");
    control.plan.bytes_per_second = None;
    assert!(bytes_at(quality(control.next(LISTS, true)).unwrap(), 1.0) > 36_000.0);
}

#[test]
fn frames_over_a_long_way_may_take_a_part_of_it() {
    let bytes_over = |rtt_micros, generate_micros| {
        let plan = CodingPlan { mode: CodingMode::Blocks, quality: 100, bytes_per_second: Some(3e5) };
        let mut control = CodingControl::new(plan);
        let mut last = 0.0;
        for _ in 0..20 {
            control.handle_generated(generate_micros);
            let link = LinkState { bytes_per_second: 1e10, is_measured: true, least_rtt_micros: rtt_micros };
            control.handle_link(link);
            let coding = control.next(LISTS, true);
            last = bytes_at(quality(coding).unwrap(), 1.0);
            control.handle_encoded(&coding, true, LISTS, last as usize, 1000);
        }
        last / 3e5
    };
    let [near, far, slow] =
        [(20_000, 20_000), (350_000, 50_000), (20_000, 380_000)].map(|(r, g)| bytes_over(r, g));
    // Seconds of the link: one thirtieth, and a quarter of 400 ms.
    assert!((0.025..0.034).contains(&near), "{near}");
    assert!((0.075..0.101).contains(&far) && (0.075..0.101).contains(&slow), "{far} {slow}");
}

#[test]
fn a_frame_of_fewer_lists_has_its_better_quality_at_once() {
    let plan = CodingPlan { mode: CodingMode::Blocks, quality: 100, bytes_per_second: Some(300_000.0) };
    let mut control = CodingControl::new(plan);
    let mut at = |num_lists: usize| {
        let coding = control.next(num_lists, true);
        let bytes = bytes_at(quality(coding).unwrap(), 1.0) * num_lists as f64 / LISTS as f64;
        control.handle_encoded(&coding, true, num_lists, bytes as usize, 1000);
        (f64::from(quality(coding).unwrap()), bytes)
    };
    for _ in 0..10 {
        at(LISTS);
    }
    let (whole, of_whole) = at(LISTS);
    let (small, of_small) = at(LISTS / 4);
    // Two octaves of bytes, by the slope of `bytes_at`.
    assert!((small - whole - 2.0 / 0.033).abs() < 12.0, "{whole} and {small}");
    assert!(of_small < 11_000.0 && of_whole < 11_000.0, "{of_whole} and {of_small} bytes");
    // And a larger one its worse: with the quality of the small one it would take four times the bytes.
    let (again, of_again) = at(LISTS);
    assert!((again - whole).abs() < 12.0 && of_again < 12_000.0, "{again}, {of_again} bytes");
}

#[test]
fn a_rest_ends_exactly_and_by_a_finer_frame_only_where_that_takes_long() {
    let mut control = CodingControl::new(CodingPlan { quality: 50, ..CodingPlan::default() });
    let first = control.next(LISTS, false);
    assert_eq!(quality(first), Some(50), "nothing is known of the link or of exact frames");
    control.handle_encoded(&first, false, LISTS, 30_000, 20_000);
    let link =
        |bytes_per_second| LinkState { bytes_per_second, is_measured: true, least_rtt_micros: 100_000 };
    let steps = |control: &CodingControl| {
        let mut steps = vec![];
        let mut last = first;
        while let Some(finer) = control.finer(LISTS, &last) {
            steps.push(quality(finer));
            last = finer;
        }
        steps
    };
    control.handle_link(link(1e8));
    assert_eq!(steps(&control), [None]);
    control.handle_link(link(8e5));
    assert_eq!(steps(&control), [Some(FINE_QUALITY), None]);
    control.plan.mode = CodingMode::Blocks;
    assert_eq!(steps(&control), []);
    control.plan.quality = 70;
    assert_eq!(steps(&control), [Some(70)]);
    control.plan.mode = CodingMode::Exact;
    assert_eq!(steps(&control), []);
}

#[test]
fn moving_frames_are_exact_only_where_the_link_does_not_feel_it() {
    let mut control = CodingControl::new(CodingPlan::default());
    let blocks = Coding::Blocks(blocks::Settings::of(60));
    control.handle_encoded(&blocks, true, LISTS, 20_000, 20_000);
    let mut coding = |exact_micros: u64, bytes_per_second| {
        control.exact_bytes = Mean::default();
        control.exact_micros = Mean::default();
        control.handle_encoded(&Coding::Exact, false, LISTS, 400_000, exact_micros);
        control.handle_link(LinkState { bytes_per_second, is_measured: true, least_rtt_micros: 20_000 });
        quality(control.next(LISTS, true))
    };
    assert_eq!(coding(20_000, 1e8), None);
    assert_eq!(coding(20_000, 5e6), Some(100), "too narrow");
    assert_eq!(coding(100, 7.5e6), Some(100), "too narrow, though blocks take longer to encode");
    assert_eq!(coding(40_000, 1e8), Some(100), "exact frames take longer to encode");
}
