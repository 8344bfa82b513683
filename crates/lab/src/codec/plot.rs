//! Rate-distortion curves as a picture for a browser.

use std::fmt::Display;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::bd::{RatePoint, front};
use super::{CodecReport, Point};
use crate::error::LabError;

/// An SVG with a chart for each scene and turn: DSSIM over bytes, both logarithmic, one line for each codec and K.
pub fn svg(report: &CodecReport) -> Result<String, LabError> {
    let mut text = String::new();
    draw(&mut text, report)
        .map_err(|cause| isinglass_bench::BenchError::Picture { path: "plot".into(), cause })?;
    Ok(text)
}

struct Series {
    label: String,
    color: RGBColor,
    is_dashed: bool,
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
    let labels = lines(report, |_| true, 0);
    let height = CHART.1.max(labels.len() as u32 * LEGEND_LINE as u32 + 2 * LEGEND_MARGIN as u32);
    let charts_width = CHART.0 * columns as u32;
    let size = (charts_width + LEGEND_WIDTH, height * rows as u32);
    let root = SVGBackend::with_string(text, size).into_drawing_area();
    root.fill(&WHITE).map_err(|e| said(&e))?;
    let (charts, beside) = root.split_horizontally(charts_width);
    legend(&beside, &labels)?;
    let areas = charts.split_evenly((rows, columns));
    for (i, area) in areas.iter().enumerate() {
        let (Some(scene), Some(angle)) = (scenes.get(i / columns), angles.get(i % columns)) else { continue };
        let all = lines(report, |p| p.scene == *scene, i % columns);
        chart(area, &format!("{scene}, {angle}°"), &all)?;
    }
    root.present().map_err(|e| said(&e))
}

/// A line for each codec and K in the report, with the wanted points.
fn lines(report: &CodecReport, is_wanted: impl Fn(&Point) -> bool, turn: usize) -> Vec<Series> {
    let mut codecs: Vec<&str> = Vec::new();
    let mut all: Vec<Series> = Vec::new();
    for p in &report.points {
        if !codecs.contains(&p.codec) {
            codecs.push(p.codec);
        }
        let label = format!("{}, K = {}", p.codec, p.k);
        if all.iter().any(|s| s.label == label) {
            continue;
        }
        let same = report.points.iter().filter(|q| is_wanted(q) && (q.codec, q.k) == (p.codec, p.k));
        let rates: Vec<RatePoint> = same.map(|q| q.rate_point(turn)).collect();
        let points =
            front(&rates).into_iter().map(|i| (rates[i].bytes.max(1.0), rates[i].dssim.max(LEAST_DSSIM)));
        let number = codecs.iter().position(|c| *c == p.codec).unwrap_or(0);
        let (color, is_dashed) = (COLORS[number % COLORS.len()], number / COLORS.len() % 2 == 1);
        all.push(Series { label, color, is_dashed, k: p.k, points: points.collect() });
    }
    all
}

impl Series {
    /// Shorter lists are thinner lines.
    fn style(&self, longest: u8) -> ShapeStyle {
        self.color.stroke_width(if self.k == longest { 2 } else { 1 })
    }
}

fn longest(all: &[Series]) -> u8 {
    all.iter().map(|s| s.k).max().unwrap_or(0)
}

fn legend(area: &DrawingArea<SVGBackend<'_>, Shift>, all: &[Series]) -> Result<(), String> {
    let longest = longest(all);
    for (i, s) in all.iter().enumerate() {
        let y = LEGEND_MARGIN + i as i32 * LEGEND_LINE;
        let dash = if s.is_dashed { DASH } else { (SAMPLE, 0) };
        let mut x = 0;
        while x < SAMPLE {
            let line = [(x, y), ((x + dash.0).min(SAMPLE), y)];
            area.draw(&PathElement::new(line, s.style(longest))).map_err(|e| said(&e))?;
            x += dash.0 + dash.1;
        }
        let font = ("sans-serif", 11).into_font();
        area.draw(&Text::new(s.label.clone(), (SAMPLE + 6, y - 6), font)).map_err(|e| said(&e))?;
    }
    Ok(())
}

fn chart(area: &DrawingArea<SVGBackend<'_>, Shift>, caption: &str, all: &[Series]) -> Result<(), String> {
    let points = || all.iter().flat_map(|s| &s.points);
    let range = |of: fn(&(f64, f64)) -> f64| {
        let (low, high) = points().map(of).fold((f64::INFINITY, 0f64), |(l, h), x| (l.min(x), h.max(x)));
        if low <= high { low / 1.2..high * 1.2 } else { 0.5..2.0 }
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
    let longest = longest(all);
    for s in all {
        let style = s.style(longest);
        let dots = s.points.iter().map(|p| Circle::new(*p, 2, s.color.filled()));
        chart.draw_series(dots).map_err(|e| said(&e))?;
        let line = s.points.iter().copied();
        match s.is_dashed {
            true => chart.draw_series(DashedLineSeries::new(line, DASH.0 as u32, DASH.1 as u32, style)),
            false => chart.draw_series(LineSeries::new(line, style)),
        }
        .map_err(|e| said(&e))?;
    }
    Ok(())
}

fn said(e: &dyn Display) -> String {
    e.to_string()
}

const CHART: (u32, u32) = (560, 420);
/// Pixels beside the charts, from a line to the next, and above the first.
const LEGEND_WIDTH: u32 = 220;
const LEGEND_LINE: i32 = 15;
const LEGEND_MARGIN: i32 = 20;
/// Length of a line there, and of a dash and its gap anywhere, pixels.
const SAMPLE: i32 = 26;
const DASH: (i32, i32) = (6, 4);
/// A logarithm has no zero.
const LEAST_DSSIM: f64 = 1e-5;
/// Colours that are distinct without red-green vision too (Okabe and Ito 2008).
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
