//! What every subcommand does alike: output folders, progress, Ctrl-C, hashes and dates.

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::{
    fs,
    io::IsTerminal,
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

/// Makes the folder and proves that it can be written to, before any work is spent.
pub fn prepare_folder(folder: &Path) -> Result<()> {
    let hint = || {
        format!(
            "cannot use {} as output folder; give a writable one with --out",
            folder.display()
        )
    };
    fs::create_dir_all(folder).with_context(hint)?;
    // permission bits say nothing about a full disk or a read-only mount: write a block
    let probe = tempfile::NamedTempFile::new_in(folder).with_context(hint)?;
    fs::write(probe.path(), [0u8; 4096]).with_context(hint)?;
    Ok(())
}

/// A progress bar on stderr if it is a terminal, else nothing.
pub fn progress(length: u64, what: &str) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::with_draw_target(Some(length), ProgressDrawTarget::stderr());
    if let Ok(style) = ProgressStyle::with_template("{prefix} [{bar:30}] {pos}/{len} {eta} {msg}") {
        bar.set_style(style.progress_chars("=> "));
    }
    bar.set_prefix(what.to_string());
    bar
}

/// A flag that Ctrl-C sets, so that a loop ends at a safe point; a second Ctrl-C ends the process.
pub fn stop_on_ctrl_c() -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    // fails only if a handler is installed already: then Ctrl-C simply ends the process, and the journal is still whole
    let _ = ctrlc::set_handler(move || {
        if flag.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
        eprintln!("\nunscrew: stopping at the next safe point (Ctrl-C again: at once)");
    });
    stop
}

/// Days since a date and time in RFC 3339; `None` if it is none.
pub fn age_days(date: &str) -> Option<f64> {
    let then: jiff::Timestamp = date.parse().ok()?;
    Some(jiff::Timestamp::now().duration_since(then).as_secs_f64() / 86_400.0)
}

/// The date and time now, UTC, for map and model files.
pub fn now_utc() -> String {
    jiff::Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}

/// Writes a JSON file aside, then renames it.
pub fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<()> {
    let mut text = serde_json::to_vec_pretty(value)?;
    text.push(b'\n');
    geometry::write_aside(path, &text)?;
    Ok(())
}

/// An error with its causes, each said once: libraries name the system's reason in their own message already.
pub fn with_causes(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if text.is_empty() {
            text = cause;
        } else if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}
