//! The headless demonstration over a table of methods, camera speeds and round-trip times.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use isinglass_client::Foresight;
use isinglass_net::LinkModel;
use serde::Serialize;

use crate::choices::{MethodChoice, Rule};
use crate::demo::{DemoOptions, Report, run_headless};
use crate::error::BenchError;
use crate::progress::note;
use crate::scenes::SceneSource;
use crate::subject::{Subject, SubjectConditions, each_scene};

/// `METHOD[@RULE][:no-prediction]`: a method, the rule by which the server makes its frames, and whether frames are
/// asked for from where the camera will be.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LatencyMethod {
    /// Method and rule. Without one the demonstration's rule is taken.
    pub choice: MethodChoice,
    /// Whether prediction is switched off, as the papers have none.
    pub never_predicts: bool,
}

impl fmt::Display for LatencyMethod {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.choice, if self.never_predicts { NO_PREDICTION } else { "" })
    }
}

impl FromStr for LatencyMethod {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        let (choice, never_predicts) = match s.strip_suffix(NO_PREDICTION) {
            Some(choice) => (choice, true),
            None => (s, false),
        };
        let choice: MethodChoice = choice.parse()?;
        if choice.rule == Some(Rule::AllSamples) {
            return Err(format!("'{s}': no server sends {}, expected a rule for frames", Rule::AllSamples));
        }
        Ok(Self { choice, never_predicts })
    }
}

/// What to measure.
#[derive(Clone, Debug)]
pub struct LatencyOptions {
    /// The scenes, see [`crate::scenes::select`].
    pub scenes: Vec<SceneSource>,
    /// Methods.
    pub methods: Vec<LatencyMethod>,
    /// Speeds of the camera.
    pub degrees_per_second: Vec<f32>,
    /// Round-trip times.
    pub rtts: Vec<Duration>,
    /// A folder for what each run writes; none: nothing is written.
    pub out: Option<PathBuf>,
    /// Everything else. What the lists above name is replaced.
    pub demo: DemoOptions,
}

/// The whole result.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyReport {
    /// What holds for all rows.
    pub conditions: LatencyConditions,
    /// One for each scene, method, speed and round-trip time.
    pub rows: Vec<LatencyRow>,
}

/// What holds for all rows.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyConditions {
    /// What holds for any table of pictures; there are no turns here.
    #[serde(flatten)]
    pub subject: SubjectConditions,
    /// Where the kernels of server and viewer ran, as it was asked for.
    pub backend: String,
    /// Pictures shown in a second.
    pub refresh_hz: f32,
}

/// One run.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyRow {
    /// Name of the scene.
    pub scene: String,
    /// What was played, and the figures of the run.
    #[serde(flatten)]
    pub report: Report,
}

/// Measures, in real time.
pub fn run(options: &LatencyOptions) -> Result<LatencyReport, BenchError> {
    options.methods.iter().try_for_each(|m| m.choice.method.check_mode(options.demo.mode))?;
    let lists = [options.scenes.len(), options.methods.len(), options.degrees_per_second.len()];
    let num_runs = lists.iter().product::<usize>() * options.rtts.len();
    let mut rows = Vec::with_capacity(num_runs);
    let failures = each_scene(&options.scenes, |scene| {
        for &rtt in &options.rtts {
            for &degrees_per_second in &options.degrees_per_second {
                for &method in &options.methods {
                    let rtt_ms = rtt.as_secs_f64() * 1e3;
                    let name = format!("{}-{rtt_ms}ms-{degrees_per_second}-{method}", scene.name);
                    note(&format!("{}/{num_runs}: {name}", rows.len() + 1));
                    let demo = demo_of(&options.demo, scene, method, degrees_per_second, rtt);
                    let out = options.out.as_ref().map(|out| out.join(name.replace([':', '/', '@'], "-")));
                    let report = run_headless(&demo, out.as_deref())?.report;
                    rows.push(LatencyRow { scene: scene.name.clone(), report });
                }
            }
        }
        Ok(())
    });
    let demo = &options.demo;
    let conditions = LatencyConditions {
        subject: subject_of(options)
            .conditions(rayon::current_num_threads(), failures.lines(rows.is_empty())?),
        backend: demo.backend.to_string(),
        refresh_hz: demo.refresh_hz,
    };
    Ok(LatencyReport { conditions, rows })
}

/// What is looked at.
fn subject_of(options: &LatencyOptions) -> Subject {
    let demo = &options.demo;
    Subject {
        scenes: options.scenes.clone(),
        transfer: demo.transfer.clone(),
        ks: vec![demo.k],
        angles_degrees: vec![],
        orbit: demo.orbit,
        intrinsics: demo.intrinsics,
        shaded: demo.shaded,
        mode: demo.mode,
        isos: demo.isos,
        clip: demo.clip,
    }
}

fn demo_of(
    demo: &DemoOptions,
    scene: &SceneSource,
    method: LatencyMethod,
    degrees_per_second: f32,
    rtt: Duration,
) -> DemoOptions {
    let layering = match method.choice.rule {
        Some(Rule::Layering(layering)) => layering,
        _ => demo.layering,
    };
    let predicts = demo.foresight.predicts && !method.never_predicts;
    DemoOptions {
        source: scene.volume.source.clone(),
        raw: scene.volume.raw,
        selection: scene.volume.selection,
        spacing: scene.volume.spacing,
        layering,
        method: method.choice.method,
        foresight: Foresight { predicts, ..demo.foresight },
        degrees_per_second,
        link: LinkModel { rtt, ..demo.link.clone() },
        ..demo.clone()
    }
}

/// A table for people.
pub fn table(report: &LatencyReport) -> String {
    let mut text = format!(
        "{:<12} {:<21} {:>7} {:>5} {:>7} {:>8} {:>8} {:>8} {:>6} {:>4} {:>8} {:>9} {:>7} {:>5}\n",
        "scene",
        "method",
        "predict",
        "deg/s",
        "rtt ms",
        "shown",
        "p95",
        "last",
        "ratio",
        "lag",
        "age ms",
        "bytes",
        "freezes",
        "rest"
    );
    for row in &report.rows {
        let r = &row.report;
        text += &format!(
            "{:<12} {:<21} {:>7} {:>5.0} {:>7.0} {:>8.4} {:>8.4} {:>8.4} {:>6.1} {:>4} {:>8.0} {:>9.0} {:>7} {:>5}\n",
            row.scene,
            r.method,
            if r.predict { "yes" } else { "no" },
            r.degrees_per_second,
            r.rtt_ms,
            r.dssim_shown_mean,
            r.dssim_shown_p95,
            r.dssim_last_image_mean,
            r.dssim_last_image_mean / r.dssim_shown_mean.max(1e-9),
            r.pose_lag_frames_max,
            r.frame_age_ms_mean,
            r.bytes_per_frame_mean,
            r.freezes,
            r.rest_max_abs_255,
        );
    }
    text
}

const NO_PREDICTION: &str = ":no-prediction";

#[cfg(test)]
mod tests {
    use isinglass_core::kernels::layering::Layering;

    use super::*;
    use crate::rivals::Method;

    #[test]
    fn a_method_is_played_as_it_is_named() {
        let demo = |method: &str| {
            let method: LatencyMethod = method.parse().unwrap();
            let scene = SceneSource::new("a", "builtin:cubus@16");
            demo_of(&DemoOptions::default(), &scene, method, 60.0, Duration::from_millis(100))
        };
        let ours = demo("layers");
        assert_eq!((ours.method, ours.layering), (Method::Layers, Layering::default()));
        assert!(ours.foresight.predicts && !demo("layers:no-prediction").foresight.predicts);
        assert_eq!((ours.degrees_per_second, ours.link.rtt), (60.0, Duration::from_millis(100)));
        assert_eq!(ours.source, "builtin:cubus@16");
        let warp = demo("point-warp@single-depth:exit:no-prediction");
        assert_eq!((warp.method, warp.layering.name()), (Method::PointWarp, "single-depth:exit"));
        assert!(!warp.foresight.predicts && warp.foresight.keeps);
        for bad in ["layers@all-samples", "warp", "layers:yes"] {
            assert!(bad.parse::<LatencyMethod>().is_err(), "{bad}");
        }
    }
}
