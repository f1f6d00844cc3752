//! A journal of a million events: how long going on and counting take.
//!
//! `cargo test --release -p unscrew --test million -- --ignored --nocapture`: it writes about a gigabyte into the temporary folder.

use cell::journal::Journal;
use cell::record::{Act, Event, UnitRecord};
use geometry::Point;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

const EVENTS: u64 = 1_000_000;
/// Finds of a face: what makes up most of a journal.
const FINDS: usize = 8;
const RESUME_S: f64 = 2.0;
const STATS_S: f64 = 3.0;

fn event(json: Value) -> Event {
    serde_json::from_value(json).expect("an event")
}

/// A unit as runs of the simulated cell have them: six looks at faces, 36 bursts, four pulls, 100 events.
fn events(start_s: f64) -> Vec<(f64, Event)> {
    let find = |k: usize| {
        serde_json::json!({"u_px": 1323.912345 + k as f64, "v_px": 897.512345, "sigma_px": 0.21234567, "diameter_px": 37.41234567,
            "score": 0.99812345, "drive": "cross", "verdict": "screw", "camera_mm": [-233.112345, -198.712345, 1480.112345],
            "base_mm": [1102.412345, 233.012345, 610.212345], "sigma_lateral_mm": 0.0812345, "sigma_depth_mm": 0.1212345,
            "hull": "inside", "tilt_rad": 0.0212345, "left_alone": null})
    };
    let mut all = vec![event(serde_json::json!({"event": "arrived"}))];
    all.push(event(serde_json::json!({"event": "identified", "model": "CU-X22"})));
    for (step, face) in ["front", "left", "right", "top", "front_inner", "right"]
        .iter()
        .enumerate()
    {
        let turn = Act::Present { face: (*face).into() };
        all.push(Event::Intent { act: turn });
        all.push(Event::Presented { face: (*face).into() });
        all.push(event(serde_json::json!({"event": "seen", "face": {
            "step": step, "step_name": "screws", "face": face, "purpose": "work", "t_s": start_s, "picture": "ab".repeat(32),
            "width_px": 4104, "height_px": 3006, "plane": null, "attempts": [],
            "found": (0..FINDS).map(find).collect::<Vec<_>>()}})));
        for found in 0..6 {
            let aim = Point::new(1100.0 + 30.0 * f64::from(found), 233.0 + step as f64, 610.0);
            all.push(Event::Intent {
                act: Act::Drive {
                    found: found as usize,
                    arm: "arm_a".into(),
                    aim,
                    burst: 0,
                },
            });
            all.push(event(
                serde_json::json!({"event": "driven", "found": found, "arm": "arm_a", "burst": {
                "program": {"axial_force_n": 150.0, "max_time_s": 2.5, "max_torque_nm": 12.0, "stroke_mm": 10.0},
                "end": "removed", "error": null, "aim": aim, "second_look": null, "time_s": 3.1}}),
            ));
        }
        all.push(event(
            serde_json::json!({"event": "verified", "screws": [[0, false]], "pictures": ["cd".repeat(32)]}),
        ));
    }
    all.push(event(
        serde_json::json!({"event": "decided", "outcome": {"outcome": "ok"}}),
    ));
    all.push(event(serde_json::json!({"event": "discharged"})));
    let timed = all.into_iter().enumerate();
    timed.map(|(k, event)| (start_s + 2.0 * k as f64, event)).collect()
}

/// What the simulated world would have logged of these events.
fn world_lines(unit: u64, events: &[(f64, Event)]) -> String {
    let drives = events.iter().filter(|(_, e)| matches!(e, Event::Driven { .. }));
    let line = |(t_s, _): &(f64, Event)| {
        let action = serde_json::json!({"t_s": t_s - 1.0, "unit": unit - 1, "kind": {"kind": "drive", "arm": "arm_a", "screw": null,
            "aim": {"lateral_mm": 0.2123456789, "depth_mm": -0.1123456789, "tilt_rad": 0.0312345678}, "end": "removed"}});
        format!("{action}\n")
    };
    drives.map(line).collect()
}

fn write(folder: &Path) -> u64 {
    let mut journal = Journal::open(folder).expect("journal");
    journal.unsynchronised().expect("set");
    let (mut count, mut world) = (0, String::new());
    while count < EVENTS {
        let start_s = count as f64 * 2.0;
        let unit = journal.begin_unit(start_s).expect("unit");
        let mut events = events(start_s);
        world.push_str(&world_lines(unit, &events));
        // the last unit stays unfinished: the program died after its last burst
        let last = (count + (events.len() as u64) < EVENTS).then(|| events.pop()).flatten();
        let mut record = UnitRecord::new(unit, start_s);
        for (t_s, event) in &events {
            journal.append(unit, *t_s, event).expect("event");
            record.apply(*t_s, event);
        }
        if let Some((t_s, event)) = last {
            record.apply(t_s, &event);
            journal.close_unit(t_s, &event, &record).expect("closed");
            count += 1;
        }
        count += events.len() as u64;
    }
    fs::write(folder.join("world.jsonl"), world).expect("written");
    count
}

#[test]
#[ignore = "minutes: writes a journal of a million events"]
fn a_million_events_are_gone_on_with_and_counted_in_seconds() {
    let folder = tempfile::tempdir().expect("folder");
    let begin = Instant::now();
    let count = write(folder.path());
    let bytes = fs::metadata(folder.path().join("journal.db")).expect("journal").len();
    println!(
        "{count} events, {} MB, written in {:.0} s",
        bytes / 1_000_000,
        begin.elapsed().as_secs_f64()
    );
    let best = |what: &str, limit_s: f64, run: &dyn Fn()| {
        let times = (0..3).map(|_| {
            let begin = Instant::now();
            run();
            begin.elapsed()
        });
        let times: Vec<Duration> = times.collect();
        let best_s = times.iter().min().expect("three").as_secs_f64();
        println!("{what}: {best_s:.3} s (best of {times:?})");
        assert!(best_s <= limit_s, "{what}: {best_s:.2} s, allowed {limit_s} s");
    };
    best("resume (open, prove, rebuild the unit under way)", RESUME_S, &|| {
        let record = Journal::open(folder.path())
            .expect("journal")
            .under_way()
            .expect("whole");
        assert_eq!(record.expect("a unit").screws_out(), 36);
    });
    let stats = |more: &[&str]| -> Value {
        let output = Command::new(env!("CARGO_BIN_EXE_unscrew"))
            .current_dir(folder.path())
            .args(["stats", ".", "--json"])
            .args(more)
            .output()
            .expect("statistics");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).expect("JSON")
    };
    best("stats", STATS_S, &|| {
        let stats = stats(&[]);
        assert_eq!(
            (&stats["actions_repeated"], &stats["actions_lost"]),
            (&Value::from(0), &Value::from(0))
        );
    });
    let begin = Instant::now();
    let anew = stats(&["--recount"]);
    println!("stats --recount: {:.1} s", begin.elapsed().as_secs_f64());
    assert_eq!(
        anew,
        stats(&[]),
        "what was written down at the end of each unit is what its events say"
    );
}
