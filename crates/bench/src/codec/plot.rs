//! Rate-distortion curves as a picture for a browser.

use std::fmt::Display;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::CodecReport;
use super::bd::{RatePoint, front};
use crate::error::BenchError;

/// An SVG with a chart for each scene and turn: DSSIM over bytes, both logarithmic, one line for each codec and K.
pub fn svg(report: &CodecReport) -> Result<String, BenchError> {
    let mut text = String::new();
    draw(&mut text, report).map_err(|cause| BenchError::Picture { path: "plot".into(), cause })?;
    Ok(text)
}

/// A line of a chart.
struct Series {
    label: String,
    color: RGBColor,
    k: u8,
    points: Vec<(f64, f64)>,
}

fn draw(text: &mut String, report: &CodecReport) -> Result<(), String> {
    let angles = &report.conditions.subject.angles_deg;
    let mut scenes: Vec<&str> = Vec::new();
    for p in &report.points {
        if !scenes.contains(&&p.scene[..]) {
            scenes.push(&p.scene);
        }
    }
    let (columns, rows) = (angles.len().max(1), scenes.len().max(1));
    let size = (CHART.0 * columns as u32, CHART.1 * rows as u32);
    let root = SVGBackend::with_string(text, size).into_drawing_area();
    root.fill(&WHITE).map_err(|e| said(&e))?;
    let areas = root.split_evenly((rows, columns));
    for (i, area) in areas.iter().enumerate() {
        let (Some(scene), Some(angle)) = (scenes.get(i / columns), angles.get(i % columns)) else { continue };
        let all = series(report, scene, i % columns);
        chart(area, &format!("{scene}, {angle}°"), &all)?;
    }
    root.present().map_err(|e| said(&e))
}

fn series(report: &CodecReport, scene: &str, turn: usize) -> Vec<Series> {
    let mut codecs: Vec<&str> = Vec::new();
    let mut all: Vec<Series> = Vec::new();
    for p in report.points.iter().filter(|p| p.scene == scene) {
        if !codecs.contains(&p.codec) {
            codecs.push(p.codec);
        }
        let label = format!("{}, K = {}", p.codec, p.k);
        if all.iter().any(|s| s.label == label) {
            continue;
        }
        let same = report.points.iter().filter(|q| (&q.scene[..], q.codec, q.k) == (scene, p.codec, p.k));
        let rates: Vec<RatePoint> = same.map(|q| q.rate_point(turn)).collect();
        let points =
            front(&rates).into_iter().map(|i| (rates[i].bytes.max(1.0), rates[i].dssim.max(LEAST_DSSIM)));
        let color = COLORS[codecs.iter().position(|c| *c == p.codec).unwrap_or(0) % COLORS.len()];
        all.push(Series { label, color, k: p.k, points: points.collect() });
    }
    all
}

fn chart(area: &DrawingArea<SVGBackend<'_>, Shift>, caption: &str, all: &[Series]) -> Result<(), String> {
    let points = || all.iter().flat_map(|s| &s.points);
    let range = |of: fn(&(f64, f64)) -> f64| {
        let (low, high) = points().map(of).fold((f64::INFINITY, 0f64), |(l, h), x| (l.min(x), h.max(x)));
        if low < high { low / 1.2..high * 1.2 } else { 0.5..2.0 }
    };
    let mut chart = ChartBuilder::on(area)
        .caption(caption, ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(64)
        .build_cartesian_2d(range(|p| p.0).log_scale(), range(|p| p.1).log_scale())
        .map_err(|e| said(&e))?;
    chart
        .configure_mesh()
        .max_light_lines(1)
        .x_desc("bytes of a frame")
        .y_desc("DSSIM")
        .draw()
        .map_err(|e| said(&e))?;
    let longest = all.iter().map(|s| s.k).max().unwrap_or(0);
    for s in all {
        // Shorter lists are thinner lines.
        let style = s.color.stroke_width(if s.k == longest { 2 } else { 1 });
        let dots = s.points.iter().map(|p| Circle::new(*p, 2, s.color.filled()));
        chart.draw_series(dots).map_err(|e| said(&e))?;
        chart
            .draw_series(LineSeries::new(s.points.iter().copied(), style))
            .map_err(|e| said(&e))?
            .label(&s.label)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerLeft)
        .label_font(("sans-serif", 11))
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK)
        .draw()
        .map_err(|e| said(&e))
}

fn said(e: &dyn Display) -> String {
    e.to_string()
}

const CHART: (u32, u32) = (560, 420);
/// A logarithm has no zero.
const LEAST_DSSIM: f64 = 1e-5;
/// Told apart also by those who see red and green alike (Okabe and Ito 2008).
const COLORS: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(0, 0, 0),
    RGBColor(150, 150, 60),
];
