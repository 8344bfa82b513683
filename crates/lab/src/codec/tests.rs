use std::sync::Arc;

use crate::rules::Rule;
use isinglass_core::camera::Intrinsics;
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_formats::{OpenOptions, load_transfer, open};
use isinglass_render::BackendChoice;

use super::*;
use isinglass_core::orbit::Orbit;

fn intrinsics() -> Intrinsics {
    Intrinsics::perspective(48, 40, 0.7)
}

/// A small frame of shells.
pub(super) fn frame(layering: Rule, k: u8) -> LayeredFrame {
    let volume = open("builtin:shells@32", &OpenOptions::default()).unwrap();
    let bounds = volume.bounds();
    let scene = Scene::new(Arc::new(volume), &load_transfer("shells").unwrap(), MarchSettings::default());
    layering.frame_of(&scene, FrameHeader::alone(Orbit::default().camera(intrinsics(), &bounds), k))
}

fn options(codecs: &[&str]) -> CodecOptions {
    let subject = Subject {
        scenes: vec![SceneSource::new("shells", "builtin:shells@32")],
        transfer: None,
        ks: vec![2, 4],
        angles_degrees: vec![0.0, 10.0],
        orbit: Orbit::default(),
        intrinsics: intrinsics(),
        shaded: true,
        mode: Default::default(),
        isos: Default::default(),
        clip: Default::default(),
    };
    CodecOptions {
        subject,
        codecs: codecs.iter().map(|c| (*c).to_owned()).collect(),
        anchor: Some(codecs[0].to_owned()),
        backend: BackendChoice::Cpu,
        list_scales: vec![1.0],
        turns_deg: vec![None],
        sequence: Some(SequenceOptions { degrees_per_second: 30.0, frames: 5, stops: true, compared: 2 }),
        times: None,
    }
}

#[test]
fn what_loses_nothing_leaves_the_picture_of_the_frame_and_what_loses_does_not() {
    let report = run(&options(&["exact", "raw-zstd", "png-published"])).unwrap();
    for k in [2, 4] {
        let of =
            |codec: &str| report.points.iter().filter(|p| p.codec == codec && p.k == k).collect::<Vec<_>>();
        let uncoded = report.uncoded.iter().find(|u| u.k == k && u.layering == "visibility-merge").unwrap();
        let dssims = |seen: &[Distortion]| seen.iter().map(|d| d.dssim).collect::<Vec<_>>();
        assert_eq!(dssims(&of("raw-zstd")[0].distortion), dssims(&uncoded.distortion));
        assert_eq!(of("raw-zstd").len(), 1);
        assert!(of("exact").iter().any(|p| dssims(&p.distortion) != dssims(&uncoded.distortion)));
        // Ten bits are half of a step of the picture: nearly, not quite the frame.
        let nearest = |turn: usize| {
            let of = of("exact").into_iter().map(|p| p.distortion[turn].dssim);
            (of.fold(f64::INFINITY, f64::min) - uncoded.distortion[turn].dssim).abs()
        };
        assert!(nearest(0) < 1e-3 && nearest(1) < 1e-3, "{} {}", nearest(0), nearest(1));
        let png = of("png-published")[0];
        assert_eq!(png.bytes, png.bytes_color_opacity_depth.unwrap().iter().sum::<usize>());
    }
    let p = &report.points[0];
    assert!((p.bits_per_pixel - p.bytes as f64 * 8.0 / 1920.0).abs() < 1e-9);
    assert!((p.mbit_s_at_30_hz - p.bytes as f64 * 240e-6).abs() < 1e-9);
    assert!(report.points.iter().all(|p| p.codec != "exact" || p.on_front_deg == [0.0, 10.0]));
    assert_eq!(report.bd_rates.len(), 2 * 3 * 2);
    assert_eq!(report.bd_means.len(), 2 * 3 * 2);
    // One point is no curve.
    assert!(report.bd_rates.iter().all(|r| r.refused.is_some() == r.bd_rate_percent.is_none()));
    // Without prediction nothing is saved, to the byte.
    assert!(report.sequences.iter().all(|s| s.bytes.len() == 5 && s.saving_percent == 0.0));

    let text = table(&report);
    assert!(text.contains("raw-zstd") && text.contains("mean") && text.contains("sequence"), "{text}");
    let plot = svg(&report).unwrap();
    assert!(plot.starts_with("<svg") && plot.contains("png-published, K = 4"));
    assert!(!plot.contains("NaN"));
}

#[test]
fn finer_blocks_are_larger_and_nearer_and_prediction_saves_where_nothing_moves() {
    let mut options = options(&["blocks", "raw-zstd"]);
    options.subject.ks = vec![4];
    let report = run(&options).unwrap();
    let points: Vec<&Point> = report.points.iter().filter(|p| p.codec == "blocks").collect();
    let (first, last) = (points[0], points[points.len() - 1]);
    assert!(first.bytes < last.bytes && first.distortion[0].dssim > last.distortion[0].dssim);
    let inter = report.sequences.iter().find(|s| s.settings.contains("inter")).unwrap();
    let resting = inter.bytes_resting.unwrap();
    assert!(resting < 0.5 * inter.bytes_intra, "{resting} of {}", inter.bytes_intra);
    let alone =
        report.sequences.iter().find(|s| s.codec == "blocks" && !s.settings.contains("inter")).unwrap();
    assert!(
        alone.bytes_resting.unwrap() > 0.5 * alone.bytes_intra,
        "nothing is saved by frames that are alone"
    );
    assert_eq!(alone.saving_percent, 0.0);
    // Frames 1, 2 and 4 move; the first is coded alone by both, and the third is at rest.
    let mean = |bytes: &[usize]| (bytes[1] + bytes[2] + bytes[4]) as f64 / 3.0;
    assert_eq!(inter.bytes[0], alone.bytes[0]);
    assert_eq!((inter.bytes_moving, inter.bytes_intra), (mean(&inter.bytes), mean(&alone.bytes)));
    assert_eq!(inter.saving_percent, 100.0 * (1.0 - inter.bytes_moving / inter.bytes_intra));
    // A picture of a predicted frame is another than of one alone, however few are compared.
    assert_ne!(inter.distortion[0].dssim, alone.distortion[0].dssim);
    assert_eq!((inter.dssim, inter.psnr_db), {
        let at_own_pose = &inter.distortion[0];
        (Some(at_own_pose.dssim), Some(at_own_pose.psnr_db))
    });
    let fields = serde_json::to_value(alone).unwrap();
    assert!(fields["dssim"].is_f64() && fields["psnr_db"].is_f64(), "{fields}");
}

/// Depths matter at a turn only: settings that are best at the own pose are none that a search for both together asks
/// for.
#[test]
fn settings_are_searched_for_every_turn_as_well_as_for_all() {
    let searched = |angles: &[f32]| {
        let mut options = CodecOptions { sequence: None, ..options(&["blocks-planes"]) };
        options.subject.ks = vec![4];
        options.subject.angles_degrees = angles.to_vec();
        let settings = run(&options).unwrap().points.into_iter().map(|p| p.settings);
        settings.collect::<std::collections::BTreeSet<_>>()
    };
    let [own, turned, both] = [searched(&[0.0]), searched(&[10.0]), searched(&[0.0, 10.0])];
    assert!(both.is_superset(&own) && both.is_superset(&turned));
    assert!(!turned.is_superset(&own) && !own.is_superset(&turned), "one search would do for both");
}

#[test]
fn an_anchor_is_measured_in_any_case_and_one_that_is_none_refused() {
    let anchored = |anchor: Option<&str>, codecs: &[&str]| {
        let options = CodecOptions { anchor: anchor.map(str::to_owned), ..options(codecs) };
        let names = contenders_of(&options)?.iter().map(|c| c.name).collect::<Vec<_>>();
        Ok::<_, LabError>((names, super::anchor(&options, &contenders_of(&options)?)))
    };
    assert_eq!(
        anchored(Some("raw-zstd"), &["exact"]).unwrap(),
        (vec!["exact", "raw-zstd"], Some("raw-zstd"))
    );
    let planes = ["blocks", "blocks-planes"];
    assert_eq!(anchored(None, &planes).unwrap(), (planes.to_vec(), Some("blocks-planes")));
    assert_eq!(anchored(None, &["exact"]).unwrap().1, None);
    let error = anchored(Some("webp"), &["exact"]).unwrap_err().to_string();
    assert!(error.contains("webp") && error.contains("raw-zstd"), "{error}");
}

#[test]
fn projections_are_left_to_codecs_that_take_them() {
    let mut options = CodecOptions { codecs: vec![], anchor: None, ..options(&["exact"]) };
    options.subject.mode = isinglass_core::mode::Mode::Mip;
    let names = |options: &CodecOptions| {
        contenders_of(options).map(|all| all.iter().map(|c| c.name).collect::<Vec<_>>())
    };
    let taken = names(&options).unwrap();
    assert!(taken.starts_with(&["exact", "raw-zstd"]) && !taken.contains(&"blocks"), "{taken:?}");
    options.codecs = vec!["blocks".into()];
    let refused = names(&options).unwrap_err().to_string();
    assert!(refused.contains("blocks") && refused.contains("mip"), "{refused}");
    options.subject.mode = Default::default();
    assert_eq!(names(&options).unwrap(), ["blocks"]);
    options.codecs = vec!["png-published".into()];
    options.list_scales = vec![0.5];
    assert!(names(&options).is_err());
}

#[test]
fn a_plot_tells_apart_all_lines_and_shows_a_single_point() {
    let mut options = CodecOptions { sequence: None, ..options(&["raw-zstd"]) };
    options.subject.ks = vec![4];
    let mut report = run(&options).unwrap();
    let point = report.points[0].clone();
    const NAMES: [&str; 12] = ["a", "b", "c", "d", "e", "f", "g", "h", "i", "j", "k", "l"];
    report.points.extend(NAMES.map(|codec| Point { codec, ..point.clone() }));
    let plot = svg(&report).unwrap();
    for name in NAMES {
        assert!(plot.contains(&format!("{name}, K = 4")), "{name}");
    }
    let centers: Vec<&str> = plot.split("cx=\"").skip(1).map(|s| s.split('"').next().unwrap()).collect();
    let (left, right) = (80, 530);
    assert!(!centers.is_empty());
    for center in centers {
        let x = center.parse::<i32>().unwrap() % 560;
        assert!((left..right).contains(&x), "a lone point lies at the edge: {x}");
    }
}

#[test]
fn fewer_lists_are_for_all_but_what_is_as_published_and_turns_for_blocks() {
    let mut options = CodecOptions {
        sequence: None,
        list_scales: vec![1.0, 0.5],
        turns_deg: vec![None, Some(0)],
        ..options(&["blocks", "raw-zstd", "png-published"])
    };
    options.subject.ks = vec![4];
    let report = run(&options).unwrap();
    let Intrinsics { width, height, .. } = options.subject.intrinsics;
    let half = format!("{}×{} lists", width / 2, height / 2);
    let bytes = |codec: &str, of_half: bool| -> Vec<usize> {
        let points =
            report.points.iter().filter(|p| p.codec == codec && p.settings.contains(&half) == of_half);
        points.map(|p| p.bytes).collect()
    };
    for codec in ["blocks", "raw-zstd"] {
        let (whole, half) = (bytes(codec, false), bytes(codec, true));
        assert_eq!(whole.len(), half.len(), "{codec}");
        // A quarter of the lists, and what is the same for both.
        let pairs = || whole.iter().zip(&half);
        assert!(
            pairs().all(|(whole, half)| half < whole && half * 6 > *whole),
            "{codec}: {whole:?}, {half:?}"
        );
    }
    // Blocks have the choice of turns too.
    let seen_at = |codec: &str| {
        report.points.iter().filter(|p| p.codec == codec && p.settings.contains("seen at 0°")).count()
    };
    assert_eq!((2 * seen_at("blocks"), seen_at("raw-zstd")), (2 * bytes("blocks", false).len(), 0));
    assert!(!bytes("png-published", false).is_empty() && bytes("png-published", true).is_empty());
    let of_half = |u: &&Uncoded| u.layering == "visibility-merge" && u.lists == [width / 2, height / 2];
    assert_eq!(report.uncoded.iter().filter(of_half).count(), 1);
}

#[test]
fn means_are_over_the_scenes_that_have_one() {
    let row = |scene: &str, percent: Option<f64>| BdRow {
        scene: scene.into(),
        k: Some(4),
        codec: "exact",
        angle_deg: 0.0,
        bd_rate_percent: percent,
        middle_percent: percent.map(|p| p + 10.0),
        range_db: None,
        refused: percent.is_none().then(|| "finer everywhere".into()),
    };
    let means = means(&[row("a", Some(-50.0)), row("b", None), row("c", Some(-70.0))]);
    assert_eq!(means.len(), 1);
    assert_eq!((means[0].bd_rate_percent, means[0].scenes, means[0].refused), (Some(-60.0), 2, 1));
    assert_eq!(means[0].middle_percent, Some(-50.0));
}

#[test]
fn times_are_of_every_coding_and_number_of_threads_and_predicted_frames_are_smaller() {
    let times = Some(TimeOptions { threads: vec![1, 2], rounds: 2 });
    let mut options = CodecOptions { sequence: None, times, ..options(&["raw-zstd"]) };
    options.subject.ks = vec![4];
    let report = run(&options).unwrap();
    assert_eq!(report.times.len(), 3 * 2);
    for pair in report.times.chunks(2) {
        assert_eq!(pair.iter().map(|t| t.threads).collect::<Vec<_>>(), [1, 2]);
        // However many threads, the same bytes.
        assert_eq!(pair[0].intra.bytes, pair[1].intra.bytes);
        let bytes = |t: &TimeRow| t.inter.map(|inter| inter.bytes);
        assert_eq!(bytes(&pair[0]), bytes(&pair[1]));
        assert_eq!(bytes(&pair[0]).is_some(), pair[0].settings.starts_with("blocks"));
        assert!(bytes(&pair[0]).is_none_or(|inter| inter < pair[0].intra.bytes));
        let all = pair.iter().flat_map(|t| [Some(t.intra), t.inter]).flatten();
        assert!(all.into_iter().all(|t| t.encode_ms > 0.0 && t.decode_ms > 0.0));
    }
    assert!(table(&report).contains("quality 45"));
}

/// The curve of a codec that loses comes near the frame that no codec has touched as it spends more.
#[cfg(feature = "rivals")]
#[test]
fn rivals_approach_the_uncoded_frame_as_they_spend() {
    let names = ["jpeg2000-published", "jpeg2000-planes", "avif-planes"];
    let mut options = CodecOptions { sequence: None, ..options(&names) };
    options.subject.ks = vec![4];
    let report = run(&options).unwrap();
    let uncoded = report.uncoded.iter().find(|u| u.layering == "equal-transmittance").unwrap();
    for name in names {
        for turn in 0..2 {
            let mut curve: Vec<&Point> = report
                .points
                .iter()
                .filter(|p| p.codec == name && p.on_front_deg.contains(&[0.0, 10.0][turn]))
                .collect();
            curve.sort_by_key(|p| p.bytes);
            let excess = |p: &Point| p.distortion[turn].dssim - uncoded.distortion[turn].dssim;
            let (first, last) = (excess(curve[0]), excess(curve[curve.len() - 1]));
            assert!(curve.len() >= 4 && first > 0.0, "{name}: {} points, {first}", curve.len());
            // What 8 bits of C, or 10 of W, and the smoothing of depths leave on a picture of 48×40.
            assert!(last < 0.25 * first && last < 4e-3, "{name} at turn {turn}: {first} {last}");
        }
    }
    let bd = report.bd_rates.iter().find(|r| r.codec == "jpeg2000-planes" && r.angle_deg == 0.0).unwrap();
    assert!(bd.bd_rate_percent.unwrap() < 0.0, "weighted planes help JPEG 2000: {bd:?}");
}
