//! `report.html`: what a plant manager reads after a run. One page, pictures beside it, no script, no network.

use anyhow::{Context, Result};
use cell::{
    record::{Assist, FaceRecord, Found, Method, Outcome, Purpose, ScrewAttempt, Times, UnitRecord, Verdict},
    statistics::{Rate, Statistics},
};
use geometry::{Base, Point};
use std::{collections::HashMap, fmt::Write as _, path::Path};

/// The paper's figures, section 5 (120 units).
mod paper {
    pub const OK_IN_SCOPE: &str = "78.3 % (68.8 to 85.5)";
    pub const OK_OF_ALL: &str = "60.0 % (51.1 to 68.3)";
    pub const CYCLE: &str = "193 s";
    pub const PARTS: [(&str, &str); 4] = [
        ("handling", "45 s"),
        ("screws", "80 s"),
        ("covers", "45 s"),
        ("inspection", "30 s"),
    ];
}

/// A screw that truth says was on a face when it was looked at, and that was not found: known in simulation only.
#[derive(Clone, Copy, Debug)]
pub struct Missed {
    /// Centre in the picture, px.
    pub u_px: f64,
    /// Centre in the picture, px.
    pub v_px: f64,
    /// Head diameter, px.
    pub diameter_px: f64,
    /// False where even a person could not see its slot.
    pub detectable: bool,
}

/// Everything the page shows.
pub struct Report<'a> {
    /// Units in order.
    pub records: &'a [UnitRecord],
    /// Rates and times over them.
    pub statistics: &'a Statistics,
    /// One line on how the cell was calibrated.
    pub calibration: &'a str,
    /// One line on what was run: seeds, model, version.
    pub provenance: &'a str,
    /// By unit number and index of the face's look: what was missed, where truth is known.
    pub missed: &'a HashMap<(u64, usize), Vec<Missed>>,
}

const STYLE: &str = "
:root{--ink:#1c2430;--soft:#5b6675;--line:#dfe4ea;--paper:#fff;--back:#f4f6f8;--ok:#1b8a4b;--ng:#c0392b;--ex:#8a6d1b;--blue:#2468c0}
*{box-sizing:border-box}body{margin:0;background:var(--back);color:var(--ink);font:15px/1.5 system-ui,'Segoe UI',Roboto,'Noto Sans',sans-serif}
main{max-width:1180px;margin:0 auto;padding:28px 20px 60px}h1{font-size:26px;margin:0 0 4px}h2{font-size:19px;margin:34px 0 10px}h3{font-size:15px;margin:18px 0 6px}
p{margin:6px 0}.soft{color:var(--soft)}.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(190px,1fr));gap:12px;margin:18px 0}
.card{background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:14px 16px}.card b{display:block;font-size:26px;line-height:1.2}
.card span{color:var(--soft);font-size:13px}table{border-collapse:collapse;background:var(--paper);width:100%;font-size:14px}
th,td{border-bottom:1px solid var(--line);padding:6px 10px;text-align:left;vertical-align:top}th{color:var(--soft);font-weight:600}td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}
.unit{background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:16px 18px;margin:16px 0}.unit>summary{cursor:pointer;list-style:none;display:flex;flex-wrap:wrap;gap:6px 14px;align-items:baseline}
.unit>summary::-webkit-details-marker{display:none}.badge{color:#fff;border-radius:4px;padding:1px 9px;font-weight:600;font-size:13px}.ok{background:var(--ok)}.ng{background:var(--ng)}.excluded{background:var(--ex)}.open{background:var(--soft)}
.faces{display:grid;grid-template-columns:repeat(auto-fit,minmax(480px,1fr));gap:16px;margin-top:12px}@media(max-width:560px){.faces{grid-template-columns:1fr}}
figure{margin:0}figure svg{width:100%;height:auto;display:block;border-radius:6px;background:#222}figcaption{font-size:13px;color:var(--soft);margin-top:4px}figcaption b{color:var(--ink)}
.key{display:flex;flex-wrap:wrap;gap:4px 16px;font-size:13px;color:var(--soft)}.key i{display:inline-block;width:11px;height:11px;border-radius:50%;border:3px solid;margin-right:5px;vertical-align:-2px}
.bar{display:flex;height:16px;border-radius:4px;overflow:hidden;margin:8px 0 2px;background:var(--line)}.bar div{height:100%}details.list summary{cursor:pointer;color:var(--blue);font-size:13px;margin-top:4px}
@media print{.unit{break-inside:avoid}details:not([open])>*:not(summary){display:block}}";

const REMOVED: &str = "#2ecc71";
const FAILED: &str = "#ff4d3d";
const REVIEW: &str = "#f5b301";
const OTHER: &str = "#9aa7b5";
const MISSED: &str = "#ff3df2";

/// Parts of a unit's time with their colours.
fn parts(times: &Times) -> [(&'static str, f64, &'static str); 6] {
    [
        ("handling", times.handling_s, "#7f95ad"),
        ("screws", times.screws_s, "#2468c0"),
        ("covers", times.covers_s, "#1b8a4b"),
        ("inspection", times.inspection_s, "#e0a526"),
        ("recovery", times.recovery_s, "#c0392b"),
        ("waiting", times.waiting_s, "#cfd6dd"),
    ]
}

/// Writes `report.html` and the pictures it shows (`report/`) into the run's folder; the full pictures are read from `pictures/`.
pub fn write(folder: &Path, report: &Report) -> Result<()> {
    let pictures = folder.join("report");
    std::fs::create_dir_all(&pictures).with_context(|| format!("cannot make {}", pictures.display()))?;
    let mut page = String::with_capacity(1 << 16);
    head(&mut page, report)?;
    for record in report.records {
        unit(&mut page, folder, report, record)?;
    }
    page.push_str("</main></body></html>\n");
    geometry::write_aside(&folder.join("report.html"), page.as_bytes())?;
    Ok(())
}

fn head(page: &mut String, report: &Report) -> Result<()> {
    let s = report.statistics;
    let detected: usize = report
        .records
        .iter()
        .flat_map(|r| &r.faces)
        .map(|f| f.attempts.len())
        .sum();
    write!(
        page,
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
<title>unscrew: {} units</title><style>{STYLE}</style></head><body><main><h1>{} outdoor {} taken through the cell</h1>\
<p class=\"soft\">Simulated cell: pictures are rendered, robots and driver are models; every screw was found by the detector and every \
coordinate went through the fitted map. {}</p><p class=\"soft\">{}</p>",
        s.units,
        s.units,
        if s.units == 1 { "unit" } else { "units" },
        escape(report.calibration),
        escape(report.provenance),
    )?;
    write!(
        page,
        "<div class=\"cards\"><div class=\"card\"><b>{} of {}</b><span>OK, of the units in scope</span></div>\
<div class=\"card\"><b>{}</b><span>excluded before acting</span></div><div class=\"card\"><b>{}</b><span>mean cycle, OK and NG units</span></div>\
<div class=\"card\"><b>{} of {detected}</b><span>screws taken out, of those attempted</span></div></div>",
        s.ok,
        s.ok + s.ng,
        s.excluded,
        seconds(s.cycle_mean_s),
        s.screws_removed.hits,
    )?;
    page.push_str(
        "<h2>Beside the paper</h2><table><tr><th></th><th class=\"n\">this run</th><th class=\"n\">95 % bounds</th><th class=\"n\">paper (120 real units)</th></tr>",
    );
    rate_row(page, "completed, of units in scope", &s.ok_in_scope, paper::OK_IN_SCOPE)?;
    rate_row(page, "completed, of all units", &s.ok_of_all, paper::OK_OF_ALL)?;
    write!(
        page,
        "<tr><td>mean cycle</td><td class=\"n\">{}</td><td class=\"n\"></td><td class=\"n\">{}</td></tr>",
        seconds(s.cycle_mean_s),
        paper::CYCLE
    )?;
    let times = parts(&s.times_mean);
    for (name, paper_s) in paper::PARTS {
        let own = times.iter().find(|t| t.0 == name).map(|t| t.1);
        write!(
            page,
            "<tr><td>&emsp;{name}</td><td class=\"n\">{}</td><td></td><td class=\"n\">{paper_s}</td></tr>",
            seconds(own.filter(|_| s.cycle_mean_s.is_some()))
        )?;
    }
    write!(
        page,
        "<tr><td>&emsp;recovery</td><td class=\"n\">{}</td><td></td><td class=\"n\">–</td></tr></table>\
<p class=\"soft\">The paper's figures are from real units in a real cell; these are from a simulated one. They stand side by side to show the \
distance, not to claim it.</p>",
        seconds(s.cycle_mean_s.map(|_| s.times_mean.recovery_s))
    )?;
    if !s.causes.is_empty() {
        page.push_str("<h2>Why units were not finished</h2><table><tr><th>cause</th><th class=\"n\">units</th></tr>");
        for (cause, count) in &s.causes {
            write!(
                page,
                "<tr><td>{}</td><td class=\"n\">{count}</td></tr>",
                escape(&cause.replace('_', " "))
            )?;
        }
        page.push_str("</table>");
    }
    write!(
        page,
        "<h2>Unit by unit</h2><div class=\"key\"><span><i style=\"border-color:{REMOVED}\"></i>taken out</span><span><i style=\"border-color:{FAILED}\"></i>attempted, still there</span>\
<span><i style=\"border-color:{REVIEW}\"></i>for a person to look at</span><span><i style=\"border-color:{OTHER}\"></i>other fastener or out of range: left alone</span>\
<span><i style=\"border-color:{MISSED}\"></i>missed; dashed: hidden (known from the simulator's truth only)</span></div>"
    )?;
    Ok(())
}

fn rate_row(page: &mut String, name: &str, rate: &Rate, paper: &str) -> Result<()> {
    write!(
        page,
        "<tr><td>{name}</td><td class=\"n\">{} ({} of {})</td><td class=\"n\">{:.1} to {:.1} %</td><td class=\"n\">{paper}</td></tr>",
        rate.rate.map_or("–".into(), |r| format!("{:.1} %", 100.0 * r)),
        rate.hits,
        rate.of,
        100.0 * rate.low,
        100.0 * rate.high
    )?;
    Ok(())
}

/// How a unit was finished, in words.
fn with_help(record: &UnitRecord) -> String {
    let help = match record.assist {
        Assist::None => "",
        Assist::Remote => ", with a person's clicks",
        Assist::Hand => ", with a person's hand",
    };
    let cost = match record.method {
        Method::NonDestructive => "",
        Method::Destructive => ", heads milled off",
    };
    format!("every cover is off{help}{cost}")
}

fn unit(page: &mut String, folder: &Path, report: &Report, record: &UnitRecord) -> Result<()> {
    let (badge, class, detail) = match &record.outcome {
        None => ("under way", "open", String::new()),
        Some(Outcome::Ok) => ("OK", "ok", with_help(record)),
        Some(Outcome::Ng { detail, .. }) => ("NG", "ng", detail.clone()),
        Some(Outcome::Excluded { detail, .. }) => ("excluded", "excluded", detail.clone()),
    };
    let removed: usize = record.faces.iter().map(FaceRecord::removed).sum();
    write!(
        page,
        "<details class=\"unit\"{}><summary><b>Unit {}</b><span class=\"badge {class}\">{badge}</span><span>{}</span><span class=\"soft\">{} · {removed} screws out · {} covers off · {:.0} s</span></summary>",
        if report.records.len() <= 4 { " open" } else { "" },
        record.unit,
        escape(&detail),
        escape(record.model.as_deref().unwrap_or("model plate not readable")),
        record
            .covers
            .iter()
            .filter(|c| c.end == cell::record::PullEnd::Off)
            .map(|c| 1 + c.takes_along.len())
            .sum::<usize>(),
        record.times.cycle_s(),
    )?;
    page.push_str("<div class=\"bar\">");
    let total: f64 = parts(&record.times).iter().map(|p| p.1).sum::<f64>().max(1e-9);
    for (name, time_s, color) in parts(&record.times) {
        if time_s > 0.0 {
            write!(
                page,
                "<div style=\"width:{:.2}%;background:{color}\" title=\"{name} {time_s:.1} s\"></div>",
                100.0 * time_s / total
            )?;
        }
    }
    page.push_str("</div><div class=\"key\">");
    for (name, time_s, color) in parts(&record.times) {
        if time_s >= 0.05 {
            write!(
                page,
                "<span><i style=\"border-color:{color};background:{color}\"></i>{name} {time_s:.1} s</span>"
            )?;
        }
    }
    page.push_str("</div><div class=\"faces\">");
    for (index, face) in record.faces.iter().enumerate() {
        let missed = report.missed.get(&(record.unit, index)).map_or(&[][..], Vec::as_slice);
        figure(page, folder, record.unit, index, face, missed)?;
    }
    page.push_str("</div></details>");
    Ok(())
}

/// The attempt at a find, if there was one.
fn attempt(face: &FaceRecord, found: usize) -> Option<&ScrewAttempt> {
    face.attempts.iter().find(|a| a.found == found)
}

fn color(face: &FaceRecord, index: usize, found: &Found) -> &'static str {
    match (attempt(face, index), found.verdict) {
        (Some(a), _) if a.removed() => REMOVED,
        (Some(_), _) => FAILED,
        (None, Verdict::Review) => REVIEW,
        (None, _) => OTHER,
    }
}

fn figure(
    page: &mut String,
    folder: &Path,
    unit: u64,
    index: usize,
    face: &FaceRecord,
    missed: &[Missed],
) -> Result<()> {
    // the picture's hash is part of the name: a copy that is there is one of this picture
    let hash = face.picture.as_ref().map_or("", |id| id.0.get(..8).unwrap_or(&id.0));
    let name = format!("unit{unit:03}-{index:02}-{}-{hash}.jpg", face.face);
    let shown = shrink(folder, face, &folder.join("report").join(&name))?;
    let (x, y, w, h) = (face.left_px, face.top_px, face.width_px, face.height_px);
    write!(
        page,
        "<figure><svg viewBox=\"{x} {y} {w} {h}\" role=\"img\" aria-label=\"{} of unit {unit}\">",
        escape(&face.face.0)
    )?;
    if shown {
        write!(
            page,
            "<image href=\"report/{name}\" x=\"{x}\" y=\"{y}\" width=\"{w}\" height=\"{h}\"/>"
        )?;
    }
    for (k, found) in face.found.iter().enumerate() {
        write!(
            page,
            "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{:.1}\" fill=\"none\" stroke=\"{}\" stroke-width=\"12\"><title>{}</title></circle>",
            found.u_px,
            found.v_px,
            (0.9 * found.diameter_px).max(30.0),
            color(face, k, found),
            escape(&tip(face, k, found)),
        )?;
    }
    for m in missed {
        let r = m.diameter_px.max(32.0);
        write!(
            page,
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"none\" stroke=\"{MISSED}\" stroke-width=\"12\"{}><title>{}</title></rect>",
            m.u_px - r,
            m.v_px - r,
            2.0 * r,
            2.0 * r,
            if m.detectable {
                ""
            } else {
                " stroke-dasharray=\"20 14\""
            },
            if m.detectable {
                "missed"
            } else {
                "hidden: too little of its head or slot shows"
            },
        )?;
    }
    let targets = face.attempts.len();
    let retries: usize = face.attempts.iter().map(ScrewAttempt::retries).sum();
    let review = face.found.iter().filter(|f| f.verdict == Verdict::Review).count();
    write!(
        page,
        "</svg><figcaption><b>{}</b> · {} · {} of {targets} screws out{}{}{}{}{}</figcaption>",
        escape(&face.face.0.replace('_', " ")),
        match face.purpose {
            Purpose::Survey => "survey, nothing touched".into(),
            Purpose::Work => escape(&face.step_name),
            Purpose::Missed => "looked again for missed screws".into(),
            Purpose::Clicked => "looked again with a person's clicks".into(),
            Purpose::LastTry => "looked again for whatever may still be a screw".into(),
            Purpose::Search => "searched around heads that were not met".into(),
        },
        face.removed(),
        counted(retries, "second attempts"),
        counted(review, "for review"),
        counted(missed.iter().filter(|m| m.detectable).count(), "missed"),
        counted(missed.iter().filter(|m| !m.detectable).count(), "hidden"),
        face.plane
            .map_or(String::new(), |p| format!(" · tilt {:.1}°", p.tilt_rad.to_degrees())),
    )?;
    if !face.found.is_empty() {
        page.push_str("<details class=\"list\"><summary>every find, with robot coordinates</summary><table><tr><th>drive</th><th>verdict</th><th class=\"n\">score</th><th class=\"n\">base x, y, z (mm)</th><th class=\"n\">± lateral, depth</th><th>result</th></tr>");
        for (k, found) in face.found.iter().enumerate() {
            let base = found.base_mm.map_or("–".into(), |p| {
                format!("{:.1}, {:.1}, {:.1}", p.x_mm(), p.y_mm(), p.z_mm())
            });
            let sigma = match (found.sigma_lateral_mm, found.sigma_depth_mm) {
                (Some(l), Some(d)) => format!("{l:.2}, {d:.2}"),
                _ => "–".into(),
            };
            write!(
                page,
                "<tr><td>{}</td><td>{}</td><td class=\"n\">{:.3}</td><td class=\"n\">{base}</td><td class=\"n\">{sigma}</td><td>{}</td></tr>",
                escape(&found.drive.replace('_', " ")),
                word(found.verdict),
                found.score,
                escape(&result(face, k, found))
            )?;
        }
        page.push_str("</table></details>");
    }
    page.push_str("</figure>");
    Ok(())
}

/// Part of a caption; nothing where there is none.
fn counted(count: usize, what: &str) -> String {
    if count > 0 {
        format!(" · {count} {what}")
    } else {
        String::new()
    }
}

fn word(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Screw => "screw",
        Verdict::Other => "other",
        Verdict::Review => "review",
    }
}

fn tip(face: &FaceRecord, index: usize, found: &Found) -> String {
    format!(
        "{} ({}, {:.3}): {}",
        word(found.verdict),
        found.drive,
        found.score,
        result(face, index, found)
    )
}

/// What became of a find, in words.
fn result(face: &FaceRecord, index: usize, found: &Found) -> String {
    let Some(attempt) = attempt(face, index) else {
        return match (&found.left_alone, &found.refusal) {
            (Some(why), Some(detail)) => format!("left alone: {why} ({detail})"),
            (Some(why), None) => format!("left alone: {why}"),
            (None, _) => "not reached in this step".into(),
        };
    };
    let end = match attempt.end() {
        _ if attempt.milled() && attempt.removed() => "milled off",
        _ if attempt.removed() => "taken out",
        _ if attempt.absent() => "no screw there after all",
        Some(cell::device::DriveEnd::Removed) => "driver said out, picture says it is still there",
        Some(cell::device::DriveEnd::CamOut) => "bit slipped out",
        Some(cell::device::DriveEnd::Seized) => "seized",
        Some(cell::device::DriveEnd::MissedHead) => "bit did not find the recess",
        Some(cell::device::DriveEnd::TimeOut) => "driver did not end in time",
        None => "a device failed before the driver ran",
    };
    let tries = attempt.bursts.len();
    let decision = attempt.decision.as_ref().map_or(String::new(), |d| {
        let at = |p: &Point<Base>| format!("({:.1}, {:.1}, {:.1})", p.x_mm(), p.y_mm(), p.z_mm());
        let path = d.path.iter().map(at).collect::<Vec<_>>().join(" to ");
        let cutter = if path.is_empty() {
            path
        } else {
            format!("; cutter from {path} mm")
        };
        format!(" · {}{cutter}", d.because)
    });
    format!(
        "{end}, {} by {}, {:.1} s{decision}",
        if tries == 1 {
            "one attempt".into()
        } else {
            format!("{tries} attempts")
        },
        attempt.arm,
        attempt.time_s()
    )
}

/// A copy of the face's picture that a page can carry; false if none was kept.
fn shrink(folder: &Path, face: &FaceRecord, to: &Path) -> Result<bool> {
    let Some(id) = &face.picture else {
        return Ok(false);
    };
    if to.exists() {
        return Ok(true); // the page is written after every unit
    }
    let from = cell::journal::picture_path(folder, id);
    let picture = geometry::read_color(&from)?;
    let width = 1368.min(picture.width());
    let height = (u64::from(picture.height()) * u64::from(width) / u64::from(picture.width().max(1))).max(1) as u32;
    geometry::write_jpeg(to, &image::imageops::thumbnail(&picture, width, height), 84)?;
    Ok(true)
}

fn seconds(time_s: Option<f64>) -> String {
    time_s.map_or("–".into(), |t| format!("{t:.1} s"))
}

pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
