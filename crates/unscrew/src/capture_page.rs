//! The page that a capture keeps up to date: where the marker was, where it was not found, and how well a map fits so far.

use crate::diagnosis::{Drawn, STYLE, cut, picture_file};
use anyhow::{Result, anyhow};
use calibration::{Judged, Map, Pair, Settings, Target, Volume};
use geometry::Point;
use image::RgbImage;
use std::collections::{BTreeMap, HashSet};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Rows that a map is fitted to, at least.
const ENOUGH: usize = 25;
/// The page is written this often at most: a fit and three pictures take a part of it.
const PAUSE: Duration = Duration::from_secs(2);

/// Where a capture shows itself.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Shown {
    /// Page to keep up to date while the marker goes round (HTML, loads itself again): coverage, misses, residuals so far
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
    /// Folder for what the camera saw at each visit; `calibrate report --pictures` shows what was not believed
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
}

/// A capture on its way.
pub struct CapturePage<'a> {
    shown: &'a Shown,
    plan: &'a [Target],
    volume: Volume,
    pairs: Vec<Pair>,
    /// Misses by what the camera said.
    misses: BTreeMap<String, usize>,
    written: Option<Instant>,
}

impl<'a> CapturePage<'a> {
    /// # Arguments
    /// * `before` – rows of an earlier capture that this one goes on with.
    pub fn new(shown: &'a Shown, plan: &'a [Target], volume: Volume, before: Vec<Pair>) -> Result<Self> {
        if let Some(folder) = &shown.pictures {
            crate::output::prepare_folder(folder)?;
        }
        Ok(Self {
            shown,
            plan,
            volume,
            pairs: before,
            misses: BTreeMap::new(),
            written: None,
        })
    }

    /// Takes in a visit.
    pub fn add(&mut self, pair: &Pair, miss: Option<&str>, picture: Option<&RgbImage>) -> Result<()> {
        if let Some((folder, picture)) = self.shown.pictures.as_ref().zip(picture) {
            geometry::write_jpeg(&picture_file(folder, pair.id), picture, 90)?;
        }
        if self.shown.page.is_none() {
            return Ok(());
        }
        self.pairs.push(pair.clone());
        if let Some(miss) = miss {
            *self.misses.entry(miss.to_owned()).or_default() += 1;
        }
        if self.written.is_none_or(|at| at.elapsed() > PAUSE) {
            self.write(false)?;
        }
        Ok(())
    }

    /// Writes the page, aside and then renamed; the last one does not load itself again.
    pub fn write(&mut self, done: bool) -> Result<()> {
        if let Some(path) = &self.shown.page {
            let page = self.page(done).map_err(|e| anyhow!("the page cannot be drawn: {e}"))?;
            geometry::write_aside(path, page.as_bytes())?;
            self.written = Some(Instant::now());
        }
        Ok(())
    }

    fn page(&self, done: bool) -> Drawn {
        let found = self.pairs.iter().filter(|p| p.valid).count();
        // too few, all in a plane, or not of one world yet: no map, no arrows
        let fitted = (found >= ENOUGH)
            .then(|| Map::fit(&self.pairs, &Settings::default()).ok())
            .flatten();
        let rejected: HashSet<u64> = fitted
            .iter()
            .flat_map(|(_, report)| report.rejected.iter().map(|r| r.id))
            .collect();
        let visits: Vec<Judged> = self
            .pairs
            .iter()
            .map(|pair| judged(pair, fitted.as_ref().map(|f| &f.0), !rejected.contains(&pair.id)))
            .collect();
        let been: HashSet<u64> = self.pairs.iter().map(|p| p.id).collect();
        let ahead: Vec<Point<_>> = self
            .plan
            .iter()
            .filter(|t| !been.contains(&t.id))
            .map(|t| t.command)
            .collect();
        let mut out = String::with_capacity(1 << 15);
        let again = if done {
            ""
        } else {
            "<meta http-equiv=\"refresh\" content=\"2\">"
        };
        write!(
            out,
            "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\">{again}<meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
<title>unscrew: capture</title><style>{STYLE}</style></head><body><main><h1>{}</h1><div class=\"cards\">",
            if done { "Captured" } else { "Capturing" }
        )?;
        let mut card =
            |figure: String, what: &str| write!(out, "<div class=\"card\"><b>{figure}</b><span>{what}</span></div>");
        card(format!("{} of {}", self.pairs.len(), self.plan.len()), "places visited")?;
        card(found.to_string(), "with the marker measured")?;
        if let Some((_, report)) = &fitted {
            let errors = &report.held_out.total;
            card(
                format!("{:.3} mm", errors.rms_mm),
                "rms of pairs left out of the fit so far",
            )?;
            card(format!("{:.3} mm", errors.p95_mm), "95 % of them are within")?;
            card(rejected.len().to_string(), "pairs not believed")?;
        }
        out.push_str("</div>");
        if !self.misses.is_empty() {
            out.push_str("<h2>Not measured</h2><ul>");
            for (why, times) in &self.misses {
                write!(out, "<li>{times} &times; {}</li>", crate::report::escape(why))?;
            }
            out.push_str("</ul>");
        }
        out.push_str(
            "<h2>Where</h2><p class=\"soft\">Three cuts through the middle of the volume. Dots: measured, with what the map so far leaves, 250 times its size. \
Crosses: not believed. Rings: no marker. Grey: still to come. Blue: sigma of the map so far.</p><div class=\"plots\">",
        );
        for axes in [[1, 2, 0], [0, 2, 1], [0, 1, 2]] {
            let map = fitted.as_ref().map(|f| &f.0);
            write!(
                out,
                "<figure>{}</figure>",
                cut(map, &self.volume, &visits, &ahead, axes)?
            )?;
        }
        out.push_str("</div></main></body></html>\n");
        Ok(out)
    }
}

/// What the map so far says of a pair that it may have been fitted to.
fn judged(pair: &Pair, map: Option<&Map>, used: bool) -> Judged {
    let mapped = pair
        .camera
        .filter(|_| pair.valid)
        .zip(map)
        .map(|(camera, map)| map.apply(camera));
    let error = mapped.map_or([0.0; 3], |m| (m.base.vector() - pair.command.vector()).into());
    Judged {
        id: pair.id,
        t_s: pair.t_s,
        command: pair.command,
        mapped,
        error_mm: error,
        lateral_mm: 0.0,
        depth_mm: 0.0,
        used: used && pair.valid,
    }
}
