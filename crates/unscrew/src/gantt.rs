//! A plan as a chart: one page with its drawing inside, no script, no network.

use crate::plan::summary;
use anyhow::Result;
use cell::schedule::{Kind, Placed, Plan, Problem};
use std::fmt::Write as _;

/// Left edge of the chart, px.
const LEFT: f64 = 110.0;
/// Width of the chart, px.
const WIDTH: f64 = 1220.0;
/// Height of a lane, px.
const LANE: f64 = 54.0;
/// Height of a bar, px.
const BAR: f64 = 28.0;
/// Above the lanes, px.
const TOP: f64 = 26.0;

const COLOURS: [(&str, &str); 8] = [
    ("load, discharge", "#a9bacb"),
    ("turn", "#d9e1e8"),
    ("picture", "#f0bf4c"),
    ("processing", "#f9e7bd"),
    ("screws: on the way", "#a9c8f0"),
    ("screw driven", "#3f7fd0"),
    ("cover pulled", "#63bd8a"),
    ("cover laid aside", "#c4e6d3"),
];

fn colour(name: &str) -> &'static str {
    COLOURS
        .iter()
        .find(|(n, _)| *n == name)
        .map_or("#999", |(_, colour)| colour)
}

/// The page.
pub fn page(problem: &Problem, plan: &Plan) -> Result<String> {
    let mut chart = Chart::new(problem, plan);
    for placed in &plan.placed {
        chart.task(placed)?;
    }
    chart.turns()?;
    let height = chart.height();
    let axis = chart.axis()?;
    let mut legend = String::new();
    for (name, colour) in COLOURS {
        write!(legend, "<span><i style=\"background:{colour}\"></i>{name}</span>")?;
    }
    Ok(format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
<title>unscrew: plan</title><style>body{{margin:0;background:#fff;color:#1c2430;font:15px/1.5 system-ui,'Segoe UI',Roboto,'Noto Sans',sans-serif}}\
main{{max-width:1380px;margin:0 auto;padding:24px 16px}}h1{{font-size:24px;margin:0 0 4px}}p{{margin:4px 0 14px;color:#46505e}}\
.chart{{overflow-x:auto}}svg{{min-width:1100px;width:100%;height:auto;display:block}}text{{font:12px system-ui,'Segoe UI',Roboto,'Noto Sans',sans-serif;fill:#1c2430}}\
.lane{{font-weight:600;font-size:13px}}.in{{font-size:11px}}.legend{{display:flex;flex-wrap:wrap;gap:4px 18px;margin:12px 0;font-size:13px}}\
.legend i{{display:inline-block;width:14px;height:14px;border-radius:3px;margin-right:6px;vertical-align:-2px;border:1px solid #8a97a5}}</style></head>\
<body><main><h1>{}</h1><p>{}</p><div class=\"chart\"><svg viewBox=\"0 0 {} {height}\" role=\"img\" aria-label=\"Gantt chart of the plan\">{axis}{}</svg></div>\
<div class=\"legend\">{legend}</div><p>Durations but the ways between screws are assumptions of the product description. Point at a bar for its times.</p></main></body></html>\n",
        escape(&problem.product.product),
        escape(&summary(problem, plan)),
        LEFT + WIDTH + 20.0,
        chart.bars,
    ))
}

struct Chart<'a> {
    problem: &'a Problem,
    plan: &'a Plan,
    px_s: f64,
    bars: String,
}

impl<'a> Chart<'a> {
    fn new(problem: &'a Problem, plan: &'a Plan) -> Self {
        Self {
            problem,
            plan,
            px_s: WIDTH / (plan.makespan_s.max(1.0) * 1.01),
            bars: String::new(),
        }
    }

    /// Lanes: table and camera by table, then the arms.
    fn lanes(&self) -> Vec<String> {
        let tables = self.problem.station.tables_y_mm.len();
        let number = |k: usize| {
            if tables > 1 {
                format!(" {}", k + 1)
            } else {
                String::new()
            }
        };
        let stands = (0..tables).flat_map(|k| [format!("table{}", number(k)), format!("camera{}", number(k))]);
        let arms = self.problem.station.arms.iter().map(|arm| arm.name.replace('_', " "));
        stands.chain(arms).collect()
    }

    fn height(&self) -> f64 {
        TOP + LANE * self.lanes().len() as f64 + 30.0
    }

    fn arm_lane(&self, arm: usize) -> usize {
        2 * self.problem.station.tables_y_mm.len() + arm
    }

    fn bar(&mut self, lane: usize, span_s: [f64; 2], colour: &str, label: &str, title: &str) -> Result<()> {
        let [from_s, to_s] = span_s;
        let (x, width) = (LEFT + from_s * self.px_s, (to_s - from_s) * self.px_s);
        let y = TOP + LANE * lane as f64 + 0.5 * (LANE - BAR);
        write!(
            self.bars,
            "<g><title>{}: {from_s:.1} to {to_s:.1} s</title><rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{BAR}\" rx=\"2\" \
fill=\"{colour}\" stroke=\"#fff\" stroke-width=\"0.6\"/></g>",
            escape(title)
        )?;
        self.label(lane, x + 0.5 * width, width, 4.0, label)
    }

    /// A label inside a bar, if it fits.
    fn label(&mut self, lane: usize, x: f64, room: f64, down: f64, label: &str) -> Result<()> {
        if label.is_empty() || 5.6 * label.chars().count() as f64 > room {
            return Ok(());
        }
        let y = TOP + LANE * (lane as f64 + 0.5) + down;
        write!(
            self.bars,
            "<text class=\"in\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"middle\" pointer-events=\"none\">{}</text>",
            escape(label)
        )?;
        Ok(())
    }

    fn task(&mut self, placed: &Placed) -> Result<()> {
        let problem = self.problem;
        let task = &problem.tasks[placed.task];
        let mode = &task.modes[placed.mode];
        let times = &problem.product.times_s;
        let begin_s = placed.start_s;
        let end_s = begin_s + mode.table_s;
        let table = 2 * task.table;
        match task.kind {
            Kind::Load | Kind::Discharge => {
                let label = if task.kind == Kind::Load { "load" } else { "discharge" };
                self.bar(table, [begin_s, end_s], colour("load, discharge"), label, &task.name)?;
            }
            Kind::Look | Kind::SecondLook => {
                self.bar(table + 1, [begin_s, end_s], colour("picture"), "", &task.name)?;
                let title = format!("{}: from picture to places", task.name);
                self.bar(
                    table + 1,
                    [end_s, end_s + times.process],
                    colour("processing"),
                    "",
                    &title,
                )?;
            }
            Kind::Screws => {
                let face = &problem.product.faces[task.part].name;
                for (arm, used) in mode
                    .arms
                    .iter()
                    .enumerate()
                    .filter_map(|(a, u)| u.as_ref().map(|u| (a, u)))
                {
                    let lane = self.arm_lane(arm);
                    let stops: Vec<_> = mode.stops.iter().filter(|stop| stop.arm == arm).collect();
                    let wait_s = stops.first().map_or(0.0, |stop| (stop.start_s - 1.0).max(0.0));
                    let span_s = [begin_s + wait_s, begin_s + used.busy_s];
                    self.bar(lane, span_s, colour("screws: on the way"), "", &task.name)?;
                    for stop in &stops {
                        let title = format!("{} {}", face, stop.screw + 1);
                        let span_s = [begin_s + stop.start_s, begin_s + stop.end_s];
                        self.bar(lane, span_s, colour("screw driven"), "", &title)?;
                    }
                    let label = format!("{} ({})", face.replace('_', " "), stops.len());
                    let middle = LEFT + 0.5 * (span_s[0] + span_s[1]) * self.px_s;
                    let room = (span_s[1] - span_s[0]) * self.px_s;
                    self.label(lane, middle, room + 24.0, 0.5 * BAR + 11.0, &label)?;
                }
            }
            Kind::Cover => {
                let cover = problem.product.covers[task.part].name.replace('_', " ");
                for (arm, used) in mode
                    .arms
                    .iter()
                    .enumerate()
                    .filter_map(|(a, u)| u.as_ref().map(|u| (a, u)))
                {
                    let lane = self.arm_lane(arm);
                    let pulled = [begin_s, end_s];
                    self.bar(
                        lane,
                        pulled,
                        colour("cover pulled"),
                        &format!("{cover} cover"),
                        &task.name,
                    )?;
                    let aside = [end_s, begin_s + used.busy_s];
                    self.bar(
                        lane,
                        aside,
                        colour("cover laid aside"),
                        "",
                        &format!("{cover} cover laid aside"),
                    )?;
                }
            }
        }
        Ok(())
    }

    /// What the tables do between tasks: the sides that they show, and turns.
    fn turns(&mut self) -> Result<()> {
        let problem = self.problem;
        let units = problem.tasks.iter().map(|t| t.unit).max().map_or(0, |last| last + 1);
        for unit in 0..units {
            let mut shown: Option<(usize, f64)> = None;
            let mut lane = 0;
            // sides in the order in which they are shown: until when each was needed
            let mut spans: Vec<(usize, f64, f64)> = Vec::new();
            for placed in self.plan.placed.iter().filter(|p| problem.tasks[p.task].unit == unit) {
                let task = &problem.tasks[placed.task];
                lane = 2 * task.table;
                let end_s = placed.start_s + task.modes[placed.mode].table_s;
                if task.kind == Kind::Load {
                    shown = Some((0, end_s));
                }
                let Some(side) = task.side else { continue };
                match spans.last_mut() {
                    Some((last, _, until_s)) if *last == side => *until_s = until_s.max(end_s),
                    _ => spans.push((side, placed.start_s, end_s)),
                }
            }
            let turn_s = problem.product.times_s.turn;
            let Some((mut side, mut free_s)) = shown else { continue };
            for (next, begin_s, until_s) in spans {
                let mut shown_s = free_s;
                if next != side {
                    self.bar(lane, [free_s, free_s + turn_s], colour("turn"), "", "turn")?;
                    shown_s = free_s + turn_s;
                }
                let name = format!("{} to the camera", problem.sides[next]);
                self.bar(
                    lane,
                    [shown_s.min(begin_s), until_s],
                    "#f4f6f8",
                    &problem.sides[next],
                    &name,
                )?;
                (side, free_s) = (next, until_s);
            }
        }
        Ok(())
    }

    fn axis(&self) -> Result<String> {
        let lanes = self.lanes();
        let bottom = TOP + LANE * lanes.len() as f64;
        let mut axis = String::new();
        for (k, lane) in lanes.iter().enumerate() {
            let y = TOP + LANE * k as f64;
            let fill = if k % 2 == 0 { "#fbfcfd" } else { "#fff" };
            write!(
                axis,
                "<rect x=\"0\" y=\"{y}\" width=\"{}\" height=\"{LANE}\" fill=\"{fill}\"/><text class=\"lane\" x=\"8\" y=\"{}\">{}</text>",
                LEFT + WIDTH,
                y + 0.5 * LANE + 4.0,
                escape(lane)
            )?;
        }
        let every = if self.plan.makespan_s > 400.0 { 50 } else { 10 };
        for second in (0..=self.plan.makespan_s as usize).step_by(every) {
            let x = LEFT + second as f64 * self.px_s;
            write!(
                axis,
                "<line x1=\"{x:.1}\" y1=\"{TOP}\" x2=\"{x:.1}\" y2=\"{bottom}\" stroke=\"#e4e8ed\"/>\
<text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\">{second}{}</text>",
                bottom + 18.0,
                if second == 0 { " s" } else { "" }
            )?;
        }
        let x = LEFT + self.plan.bound_s * self.px_s;
        write!(
            axis,
            "<line x1=\"{x:.1}\" y1=\"{}\" x2=\"{x:.1}\" y2=\"{bottom}\" stroke=\"#c0392b\" stroke-width=\"1.5\" stroke-dasharray=\"5 3\"/>\
<text x=\"{:.1}\" y=\"14\" text-anchor=\"end\">bound {:.1} s</text>",
            TOP - 8.0,
            x + 4.0,
            self.plan.bound_s
        )?;
        Ok(axis)
    }
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
