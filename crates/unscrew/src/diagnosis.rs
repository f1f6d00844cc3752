//! `calibrate report`: one page on whether a map is good, in millimetres, where it is not, and what limits it.

use crate::report::escape;
use anyhow::{Result, anyhow};
use base64::Engine as _;
use calibration::{Diagnosis, Figures, Hull, Judged, Map, Volume, volume_covered};
use geometry::{Base, Point};
use plotters::prelude::*;
use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

/// Length of an arrow for each mm of error, mm of the volume.
const ARROW: f64 = 250.0;
/// Cells of the background along each side of a cut.
const CELLS: usize = 40;
/// Half the thickness of a cut, as a share of the volume's edge: together three cuts show every visit at least once.
const HALF_CUT: f64 = 0.2;

pub(crate) const STYLE: &str = "
:root{--ink:#1c2430;--soft:#5b6675;--line:#dfe4ea}body{margin:0;background:#f4f6f8;color:var(--ink);font:15px/1.5 system-ui,'Segoe UI',Roboto,'Noto Sans',sans-serif}
main{max-width:1180px;margin:0 auto;padding:28px 20px 60px}h1{font-size:26px;margin:0 0 4px}h2{font-size:19px;margin:34px 0 10px}.soft{color:var(--soft)}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(190px,1fr));gap:12px;margin:18px 0}.card{background:#fff;border:1px solid var(--line);border-radius:8px;padding:14px 16px}
.card b{display:block;font-size:26px;line-height:1.2}.card span{color:var(--soft);font-size:13px}li{margin:6px 0}
table{border-collapse:collapse;background:#fff;width:100%;font-size:14px}th,td{border-bottom:1px solid var(--line);padding:6px 10px;text-align:right;font-variant-numeric:tabular-nums}
th{color:var(--soft);font-weight:600}th:first-child,td:first-child{text-align:left}.plots{display:grid;grid-template-columns:repeat(auto-fit,minmax(360px,1fr));gap:14px}
figure{margin:0;background:#fff;border:1px solid var(--line);border-radius:8px;padding:8px}figure svg{width:100%;height:auto;display:block}figcaption{font-size:13px;color:var(--soft)}";

/// Writes the page, aside and then renamed.
///
/// # Arguments
/// * `pictures` – folder with what was seen at each visit (`calibrate capture --pictures`), to show what was not believed.
pub fn write(map: &Map, d: &Diagnosis, source: &str, pictures: Option<&Path>, path: &Path) -> Result<()> {
    let page = page(map, d, source, pictures).map_err(|e| anyhow!("the report cannot be drawn: {e}"))?;
    Ok(geometry::write_aside(path, page.as_bytes())?)
}

pub(crate) type Drawn = Result<String, Box<dyn std::error::Error>>;

fn page(map: &Map, d: &Diagnosis, source: &str, pictures: Option<&Path>) -> Drawn {
    let mut out = String::with_capacity(1 << 16);
    let total = &d.held_out.total;
    write!(
        out,
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
<title>unscrew: calibration</title><style>{STYLE}</style></head><body><main><h1>Is the map good?</h1>\
<p class=\"soft\">{} · method {} · {} pairs: {} used, {} rejected, {} without marker. Every error below is of a pair that the map was not fitted to, \
the noise of its measurement included.</p><div class=\"cards\">",
        escape(source),
        map.settings().method.name(),
        d.fit.n_pairs,
        d.fit.n_used,
        d.fit.rejected.len(),
        d.fit.n_invalid,
    )?;
    let mut card =
        |figure: String, what: &str| write!(out, "<div class=\"card\"><b>{figure}</b><span>{what}</span></div>");
    card(format!("{:.3} mm", total.rms_mm), "rms, 3D")?;
    card(format!("{:.3} mm", total.p999_mm), "99.9 % are within")?;
    card(
        format!("{:.0} %", 100.0 * d.coverage[1]),
        "of the errors in the stated 95 % interval",
    )?;
    card(
        format!("{:.0} %", 100.0 * volume_covered(map)),
        "of the volume is calibrated; the rest is its edge",
    )?;
    if let Some(half) = &d.split_half {
        card(
            format!("{:.3} mm", half.rms_mm),
            "rms between two maps from half of the pairs each",
        )?;
    }
    out.push_str("</div><h2>What limits it, and what to do</h2><ul>");
    if d.advice.is_empty() {
        out.push_str("<li>nothing stands out</li>");
    }
    for word in &d.advice {
        write!(out, "<li>{}</li>", escape(word))?;
    }
    write!(
        out,
        "</ul><h2>Where is it not?</h2><p class=\"soft\">Three cuts through the middle of the volume. Blue: the stated sigma, dark is more; white is outside what was \
calibrated. Arrows: errors, {ARROW:.0} times their size. Crosses: rejected pairs. Rings: visits without a marker.</p><div class=\"plots\">"
    )?;
    for (across, up, through) in [(1, 2, 0), (0, 2, 1), (0, 1, 2)] {
        out.push_str("<figure>");
        out.push_str(&cut(Some(map), &map.volume(), &d.visits, &[], [across, up, through])?);
        out.push_str("</figure>");
    }
    out.push_str("</div><h2>By region</h2>");
    regions(&mut out, d)?;
    out.push_str("<h2>Is sigma true, does it drift, how many points?</h2><div class=\"plots\">");
    for drawn in [spread(d)?, course(d)?, numbers(d)?] {
        write!(out, "<figure>{drawn}</figure>")?;
    }
    out.push_str("</div><h2>Pairs that were not believed</h2>");
    if d.fit.rejected.is_empty() {
        out.push_str("<p>none</p>");
    } else {
        out.push_str("<table><tr><th>pair</th><th>off by, mm</th><th>across the ray</th><th>along the ray</th><th>seen</th></tr>");
        for r in &d.fit.rejected {
            write!(
                out,
                "<tr><td>{}</td><td>{:.2}</td><td>{:.2}</td><td>{:+.2}</td><td>{}</td></tr>",
                r.id,
                r.residual_mm,
                r.lateral_mm,
                r.depth_mm,
                seen(pictures, r.id)
            )?;
        }
        out.push_str("</table>");
    }
    out.push_str("</main></body></html>\n");
    Ok(out)
}

/// File of what was seen at a visit.
pub(crate) fn picture_file(folder: &Path, id: u64) -> PathBuf {
    folder.join(format!("{id:06}.jpg"))
}

/// The picture of a visit, in the page itself.
fn seen(folder: Option<&Path>, id: u64) -> String {
    let jpeg = folder.and_then(|folder| std::fs::read(picture_file(folder, id)).ok());
    jpeg.map_or_else(String::new, |jpeg| {
        let data = base64::engine::general_purpose::STANDARD.encode(jpeg);
        format!("<img alt=\"what the camera saw at visit {id}\" width=\"120\" src=\"data:image/jpeg;base64,{data}\">")
    })
}

const AXES: [&str; 3] = ["x", "y", "z"];

/// A cut through the volume: sigma behind, errors before it; grey dots where the marker is still to go.
pub(crate) fn cut(
    map: Option<&Map>,
    volume: &Volume,
    visits: &[Judged],
    ahead: &[Point<Base>],
    [across, up, through]: [usize; 3],
) -> Drawn {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (420, 420)).into_drawing_area();
        root.fill(&WHITE)?;
        let (low, high) = (volume.at([0.0; 3]).to_array(), volume.at([1.0; 3]).to_array());
        let middle = 0.5 * (low[through] + high[through]);
        let range = |a: usize| {
            let margin = 0.06 * (high[a] - low[a]);
            low[a] - margin..high[a] + margin
        };
        let mut plot = ChartBuilder::on(&root)
            .caption(format!("{} = {middle:.0} mm", AXES[through]), ("sans-serif", 16))
            .margin(8)
            .x_label_area_size(30)
            .y_label_area_size(44)
            .build_cartesian_2d(range(across), range(up))?;
        let cells = (0..CELLS * CELLS).filter_map(|k| {
            let map = map?;
            let side = |a: usize, k: usize| {
                let range = range(a);
                let step = (range.end - range.start) / CELLS as f64;
                (range.start + step * k as f64, range.start + step * (k + 1) as f64)
            };
            let ((x0, x1), (y0, y1)) = (side(across, k % CELLS), side(up, k / CELLS));
            let mut at = [0.0; 3];
            (at[across], at[up], at[through]) = (0.5 * (x0 + x1), 0.5 * (y0 + y1), middle);
            let mapped = map.apply(map.base_from_camera().inverse() * Point::new(at[0], at[1], at[2]));
            (mapped.hull != Hull::Outside).then(|| {
                let sigma = mapped.sigma_lateral_mm.hypot(mapped.sigma_depth_mm);
                let dark = (sigma / 0.4).clamp(0.0, 1.0);
                let edge = if mapped.hull == Hull::Edge { 0.45 } else { 1.0 };
                Rectangle::new([(x0, y0), (x1, y1)], BLUE.mix(edge * (0.08 + 0.6 * dark)).filled())
            })
        });
        plot.draw_series(cells)?;
        plot.configure_mesh()
            .disable_mesh()
            .x_labels(5)
            .y_labels(5)
            .x_desc(format!("{} of the base, mm", AXES[across]))
            .y_desc(AXES[up])
            .draw()?;
        let near = |p: [f64; 3]| (p[through] - middle).abs() <= HALF_CUT * (high[through] - low[through]);
        let still: Vec<_> = ahead.iter().map(|p| p.to_array()).filter(|p| near(*p)).collect();
        plot.draw_series(
            still
                .iter()
                .map(|p| Circle::new((p[across], p[up]), 1, BLACK.mix(0.35).filled())),
        )?;
        for visit in visits.iter().filter(|v| near(v.command.to_array())) {
            let at = visit.command.to_array();
            let place = (at[across], at[up]);
            if visit.used {
                let tip = (
                    place.0 + ARROW * visit.error_mm[across],
                    place.1 + ARROW * visit.error_mm[up],
                );
                plot.draw_series([PathElement::new([place, tip], RED.stroke_width(1))])?;
                plot.draw_series([Circle::new(place, 2, RED.filled())])?;
            } else if visit.mapped.is_none() {
                plot.draw_series([Circle::new(place, 4, BLACK.mix(0.5))])?;
            } else {
                plot.draw_series([Cross::new(place, 5, BLACK.stroke_width(2))])?;
            }
        }
        root.present()?;
    }
    Ok(svg)
}

fn regions(out: &mut String, d: &Diagnosis) -> std::fmt::Result {
    out.push_str("<table><tr><th>part of the volume</th><th>pairs</th><th>rms, mm</th><th>95 % within</th><th>across the ray, rms</th><th>along it</th></tr>");
    let mut row = |name: &str, f: &Figures| {
        write!(
            out,
            "<tr><td>{name}</td><td>{}</td><td>{:.3}</td><td>{:.3}</td><td>{:.3}</td><td>{:.3}</td></tr>",
            f.n, f.total.rms_mm, f.total.p95_mm, f.lateral.rms_mm, f.depth.rms_mm
        )
    };
    row("all", &d.held_out)?;
    for (k, figures) in d.octants.iter().enumerate().filter(|(_, f)| f.n > 0) {
        let side = |a: usize| if k >> a & 1 == 1 { "high" } else { "low" };
        row(&format!("{} x, {} y, {} z", side(0), side(1), side(2)), figures)?;
    }
    out.push_str("</table>");
    Ok(())
}

/// Errors over what was stated: half normal if sigma is true.
fn spread(d: &Diagnosis) -> Drawn {
    let mut ratios: Vec<f64> = d
        .visits
        .iter()
        .filter(|v| v.used)
        .filter_map(|v| Some(v.depth_mm.abs() / v.mapped?.sigma_depth_mm))
        .collect();
    ratios.sort_by(f64::total_cmp);
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (420, 340)).into_drawing_area();
        root.fill(&WHITE)?;
        let mut plot = chart(&root, "Is sigma true? (depth)", 0.0..4.0, 0.0..1.0)?;
        plot.configure_mesh()
            .light_line_style(WHITE)
            .x_desc("error over stated sigma")
            .y_desc("share of pairs at most")
            .draw()?;
        let n = ratios.len().max(1) as f64;
        let steps = ratios.iter().enumerate().map(|(k, r)| (r.min(4.0), (k + 1) as f64 / n));
        plot.draw_series(LineSeries::new(steps, RED.stroke_width(2)))?;
        // of a normal distribution (Abramowitz and Stegun 7.1.26)
        let erf = |x: f64| {
            let t = 1.0 / (1.0 + 0.327_591_1 * x);
            let poly = [
                0.254_829_592,
                -0.284_496_736,
                1.421_413_741,
                -1.453_152_027,
                1.061_405_429,
            ];
            1.0 - poly.iter().rev().fold(0.0, |sum, c| (sum + c) * t) * (-x * x).exp()
        };
        let normal = (0..=80)
            .map(|k| f64::from(k) / 20.0)
            .map(|x| (x, erf(x / std::f64::consts::SQRT_2)));
        plot.draw_series(LineSeries::new(normal, BLACK.mix(0.5)))?;
        root.present()?;
    }
    Ok(svg)
}

/// Errors over the time of the visit.
fn course(d: &Diagnosis) -> Drawn {
    let used: Vec<&Judged> = d.visits.iter().filter(|v| v.used).collect();
    let minutes = |v: &Judged| v.t_s / 60.0;
    let last = used.iter().map(|v| minutes(v)).fold(1e-3, f64::max);
    let most = used.iter().flat_map(|v| v.error_mm).map(f64::abs).fold(0.05, f64::max);
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (420, 340)).into_drawing_area();
        root.fill(&WHITE)?;
        let title = match d.drift {
            Some(drift) => format!("Drift: {:.3} mm over the capture", drift.largest().0),
            None => "Drift: not known, no times".to_owned(),
        };
        let mut plot = chart(&root, &title, 0.0..last, -most..most)?;
        plot.configure_mesh()
            .light_line_style(WHITE)
            .x_desc("minutes")
            .y_desc("error, mm")
            .draw()?;
        for (a, color) in [RED, GREEN, BLUE].into_iter().enumerate() {
            let points = used
                .iter()
                .map(|v| Circle::new((minutes(v), v.error_mm[a]), 2, color.mix(0.6).filled()));
            plot.draw_series(points)?
                .label(AXES[a])
                .legend(move |(x, y)| Circle::new((x + 8, y), 3, color.filled()));
        }
        plot.configure_series_labels().background_style(WHITE.mix(0.8)).draw()?;
        root.present()?;
    }
    Ok(svg)
}

/// Held-out error over the number of points.
fn numbers(d: &Diagnosis) -> Drawn {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (420, 340)).into_drawing_area();
        root.fill(&WHITE)?;
        let most = d.fewer.iter().map(|f| f.points).max().unwrap_or(1) as f64;
        let high = d.fewer.iter().map(|f| f.figures.total.p99_mm).fold(0.1, f64::max);
        let mut plot = chart(&root, "How many points are needed?", 0.0..1.05 * most, 0.0..1.1 * high)?;
        plot.configure_mesh()
            .light_line_style(WHITE)
            .x_desc("points that the map is fitted to")
            .y_desc("error at the others, mm")
            .draw()?;
        for (name, color, of) in [
            ("rms", BLUE, (|f: &Figures| f.total.rms_mm) as fn(&Figures) -> f64),
            ("99 %", RED, |f| f.total.p99_mm),
        ] {
            let points: Vec<_> = d.fewer.iter().map(|f| (f.points as f64, of(&f.figures))).collect();
            plot.draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2)))?
                .label(name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], color.stroke_width(2)));
            plot.draw_series(points.into_iter().map(|p| Circle::new(p, 3, color.filled())))?;
        }
        plot.configure_series_labels().background_style(WHITE.mix(0.8)).draw()?;
        root.present()?;
    }
    Ok(svg)
}

type Plot<'a, 'b> = ChartContext<
    'a,
    SVGBackend<'b>,
    Cartesian2d<plotters::coord::types::RangedCoordf64, plotters::coord::types::RangedCoordf64>,
>;

fn chart<'a, 'b>(
    root: &'a DrawingArea<SVGBackend<'b>, plotters::coord::Shift>,
    title: &str,
    x: std::ops::Range<f64>,
    y: std::ops::Range<f64>,
) -> Result<Plot<'a, 'b>, Box<dyn std::error::Error>>
where
    'b: 'a,
{
    Ok(ChartBuilder::on(root)
        .caption(title, ("sans-serif", 16))
        .margin(8)
        .x_label_area_size(34)
        .y_label_area_size(48)
        .build_cartesian_2d(x, y)?)
}
