//! The picture of an evaluation: are scores probabilities, and what would other thresholds give?

use anyhow::{Result, anyhow};
use plotters::prelude::*;
use std::path::Path;
use training::Evaluation;

const SIZE_PX: (u32, u32) = (980, 460);

/// Draws reliability (left) and recall and precision over the threshold (right), as SVG, aside and then renamed.
pub fn draw(evaluation: &Evaluation, path: &Path) -> Result<()> {
    let mut svg = String::new();
    chart(evaluation, &mut svg).map_err(|e| anyhow!("the picture cannot be drawn: {e}"))?;
    Ok(geometry::write_aside(path, svg.as_bytes())?)
}

fn chart(evaluation: &Evaluation, svg: &mut String) -> Result<(), Box<dyn std::error::Error>> {
    let root = SVGBackend::with_string(svg, SIZE_PX).into_drawing_area();
    root.fill(&WHITE)?;
    let (left, right) = root.split_horizontally(SIZE_PX.0 / 2);
    let text = ("sans-serif", 15);

    let mut plot = ChartBuilder::on(&left)
        .caption("Are scores probabilities?", ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(44)
        .build_cartesian_2d(0.0..1.0, 0.0..1.0)?;
    plot.configure_mesh()
        .x_desc("said to be a cross screw with probability")
        .y_desc("is one (95 % Wilson bounds)")
        .label_style(text)
        .light_line_style(WHITE)
        .draw()?;
    plot.draw_series([PathElement::new([(0.0, 0.0), (1.0, 1.0)], BLACK.mix(0.4))])?;
    for bin in &evaluation.reliability {
        let (at, is) = (bin.said_mean, bin.cross.rate.unwrap_or(0.0));
        plot.draw_series([PathElement::new([(at, bin.cross.low), (at, bin.cross.high)], BLUE)])?;
        plot.draw_series([Circle::new((at, is), 4, BLUE.filled())])?;
        let place = (at - if at > 0.9 { 0.08 } else { -0.015 }, is - 0.02);
        plot.draw_series([Text::new(bin.cross.of.to_string(), place, ("sans-serif", 12))])?;
    }

    let curve = &evaluation.curve;
    let lowest = curve.iter().map(|p| p.recall.min(p.precision)).fold(0.98, f64::min);
    let floor = (10.0 * lowest).floor() / 10.0;
    let mut plot = ChartBuilder::on(&right)
        .caption("What a threshold gives", ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(44)
        .build_cartesian_2d(0.0..1.0, floor..1.0)?;
    plot.configure_mesh()
        .x_desc("acted on from this probability on")
        .label_style(text)
        .light_line_style(WHITE)
        .draw()?;
    let recall = curve.iter().map(|p| (p.threshold, p.recall));
    let precision = curve.iter().map(|p| (p.threshold, p.precision));
    plot.draw_series(LineSeries::new(recall, GREEN.stroke_width(2)))?
        .label("recall")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], GREEN.stroke_width(2)));
    plot.draw_series(LineSeries::new(precision, RED.stroke_width(2)))?
        .label("precision")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], RED.stroke_width(2)));
    plot.configure_series_labels()
        .position(SeriesLabelPosition::LowerLeft)
        .label_font(text)
        .draw()?;
    root.present()?;
    Ok(())
}
