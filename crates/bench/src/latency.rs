//! The headless demonstration over a table of contenders, camera speeds and round-trip times.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use isinglass_client::Foresight;
use isinglass_net::LinkModel;
use serde::Serialize;

use crate::demo::{DemoOptions, Report, Rival, run_headless};
use crate::error::BenchError;
use crate::progress::note;
use crate::scenes::SceneSource;
use crate::subject::{Failures, Subject, SubjectConditions, each_scene};

/// A method to play.
#[derive(Clone, Debug, Default)]
pub struct Contender {
    /// A laboratory's method in place of the product's.
    pub rival: Option<Rival>,
    /// Whether prediction is off, so that frames are requested for the present camera.
    pub never_predicts: bool,
}

impl fmt::Display for Contender {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = self.rival.as_ref().map_or("layers", |rival| &rival.name);
        write!(f, "{name}{}", if self.never_predicts { ":no-prediction" } else { "" })
    }
}

/// What to measure.
#[derive(Clone, Debug)]
pub struct LatencyOptions {
    /// The scenes, see [`crate::scenes::select`].
    pub scenes: Vec<SceneSource>,
    /// The methods, one after the other.
    pub contenders: Vec<Contender>,
    /// Speeds of the camera.
    pub degrees_per_second: Vec<f32>,
    /// Round-trip times.
    pub rtts: Vec<Duration>,
    /// A folder for the results of each run; `None` writes nothing.
    pub out: Option<PathBuf>,
    /// Everything else; the lists above replace their fields.
    pub demo: DemoOptions,
}

/// The whole result.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyReport {
    /// The conditions of all rows.
    pub conditions: LatencyConditions,
    /// One for each scene, method, speed and round-trip time.
    pub(crate) rows: Vec<LatencyRow>,
}

/// The conditions of all rows.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyConditions {
    /// The conditions of any table of pictures; there are no turns here.
    #[serde(flatten)]
    pub subject: SubjectConditions,
    /// The requested backend of server and viewer.
    pub(crate) backend: String,
    /// Displayed pictures per second.
    pub(crate) refresh_hz: f32,
}

/// One run.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyRow {
    pub(crate) scene: String,
    /// The method, and the figures of the run.
    #[serde(flatten)]
    pub(crate) report: Report,
}

/// Measures, in real time.
pub fn run(options: &LatencyOptions) -> Result<LatencyReport, BenchError> {
    let lists = [options.scenes.len(), options.contenders.len(), options.degrees_per_second.len()];
    let num_runs = lists.iter().product::<usize>() * options.rtts.len();
    let mut rows = Vec::with_capacity(num_runs);
    let failures: Failures<BenchError> = each_scene(&options.scenes, |scene| {
        for &rtt in &options.rtts {
            for &degrees_per_second in &options.degrees_per_second {
                for contender in &options.contenders {
                    let rtt_ms = rtt.as_secs_f64() * 1e3;
                    let name = format!("{}-{rtt_ms}ms-{degrees_per_second}-{contender}", scene.name);
                    note(&format!("{}/{num_runs}: {name}", rows.len() + 1));
                    let demo = demo_of(&options.demo, scene, contender, degrees_per_second, rtt);
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
    contender: &Contender,
    degrees_per_second: f32,
    rtt: Duration,
) -> DemoOptions {
    let predicts = demo.foresight.predicts && !contender.never_predicts;
    DemoOptions {
        source: scene.volume.source.clone(),
        raw: scene.volume.raw,
        selection: scene.volume.selection,
        spacing: scene.volume.spacing,
        foreign_files: scene.volume.foreign_files,
        reading: scene.volume.reading.clone(),
        rival: contender.rival.clone(),
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
            r.shown.frame_age_ms_mean,
            r.bytes_per_frame_mean,
            r.shown.freezes,
            r.rest_max_abs_255,
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_contender_is_played_as_it_is_named() {
        let demo = |never_predicts| {
            let scene = SceneSource::new("a", "builtin:cubus@16");
            let contender = Contender { rival: None, never_predicts };
            (contender.to_string(), demo_of(&DemoOptions::default(), &scene, &contender, 60.0, RTT))
        };
        let (name, ours) = demo(false);
        assert!(name == "layers" && ours.foresight.predicts);
        assert_eq!((ours.degrees_per_second, ours.link.rtt, &*ours.source), (60.0, RTT, "builtin:cubus@16"));
        let (name, late) = demo(true);
        assert!(name == "layers:no-prediction" && !late.foresight.predicts && late.foresight.keeps);
    }

    const RTT: Duration = Duration::from_millis(100);
}
