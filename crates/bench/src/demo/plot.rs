//! DSSIM over time as a picture for a browser.

use std::fmt::Display;

use plotters::prelude::*;

use super::evaluate::Evaluation;
use super::script::Script;
use crate::error::BenchError;

/// An SVG with the errors of the displayed pictures and of the last server image; rests are grey.
pub(crate) fn svg(script: &Script, evaluation: &Evaluation) -> Result<String, BenchError> {
    let mut text = String::new();
    draw(&mut text, script, evaluation)
        .map_err(|cause| BenchError::Picture { path: "plot".into(), cause })?;
    Ok(text)
}

fn draw(text: &mut String, script: &Script, evaluation: &Evaluation) -> Result<(), String> {
    let said = |e: &dyn Display| e.to_string();
    let end = script.duration().as_secs_f64();
    let pictures = &evaluation.pictures;
    let top = pictures.iter().map(|p| p.last_image.dssim.max(p.shown.dssim)).fold(1e-3, f64::max) * 1.1;
    let root = SVGBackend::with_string(text, (900, 420)).into_drawing_area();
    root.fill(&WHITE).map_err(|e| said(&e))?;
    let mut chart = ChartBuilder::on(&root)
        .caption("Difference from a full rendering while the camera moves", ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(0.0..end, 0.0..top)
        .map_err(|e| said(&e))?;
    let rests = script.rests().into_iter().map(|rest| {
        let corners = [(rest.start.as_secs_f64(), 0.0), (rest.end.as_secs_f64(), top)];
        Rectangle::new(corners, RGBColor(235, 235, 235).filled())
    });
    chart.draw_series(rests).map_err(|e| said(&e))?;
    chart
        .configure_mesh()
        .disable_x_mesh()
        .max_light_lines(1)
        .x_desc("seconds (grey: the camera rests)")
        .y_desc("DSSIM")
        .draw()
        .map_err(|e| said(&e))?;
    let series = |of: fn(&super::evaluate::Evaluated) -> f64, color: RGBColor| {
        LineSeries::new(pictures.iter().map(move |p| (p.at.as_secs_f64(), of(p))), color.stroke_width(2))
    };
    let legend = |color: RGBColor| {
        move |(x, y): (i32, i32)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2))
    };
    chart
        .draw_series(series(|p| p.last_image.dssim, LAST_COLOR))
        .map_err(|e| said(&e))?
        .label("last server image, unchanged")
        .legend(legend(LAST_COLOR));
    chart
        .draw_series(series(|p| p.shown.dssim, SHOWN_COLOR))
        .map_err(|e| said(&e))?
        .label("shown: novel view of the layered frame")
        .legend(legend(SHOWN_COLOR));
    chart
        .configure_series_labels()
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK)
        .draw()
        .map_err(|e| said(&e))?;
    root.present().map_err(|e| said(&e))
}

const LAST_COLOR: RGBColor = RGBColor(200, 80, 40);
const SHOWN_COLOR: RGBColor = RGBColor(30, 90, 180);
