//! Kills the program at random moments, lets it go on, and asks journal and world whether anything was done twice or lost. And fills its disk.
//!
//! `KILLS=300 cargo test --release -p unscrew --test kills -- --ignored --nocapture`; `MINUTES=10` ends it after that time, whatever the number;
//! `MAPS=DIR` takes a cell's maps from there instead of calibrating it first. It says how many seconds a kill took.

use rand::{RngExt, SeedableRng};
use serde_json::Value;
use std::{
    fs,
    path::Path,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

/// When to kill it.
enum Death {
    /// Not at all.
    Never,
    /// After some time, wherever it is then: starting, rendering, computing, acting.
    After(Duration),
    /// A moment after so many events of the journal: just before, in or just after an act.
    Events(usize, Duration),
}

fn start(folder: &Path, resume: bool, seed: u64) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_unscrew"));
    command.current_dir(folder).stdout(Stdio::null()).stderr(Stdio::null());
    command.args(["run", "--units", "2", "--out", "out", "--maps", "maps", "--seed"]);
    command.arg(seed.to_string());
    if resume {
        command.arg("--resume");
    }
    command.spawn().expect("the program starts")
}

/// Starts or goes on with a run; `true` once it has ended by itself, `false` if it was killed.
fn ended(folder: &Path, resume: bool, seed: u64, death: &Death) -> bool {
    let mut child = start(folder, resume, seed);
    let begin = Instant::now();
    let mark = || fs::read(folder.join("out/journal.end")).unwrap_or_default();
    let (mut last, mut events) = (mark(), 0);
    loop {
        if let Some(status) = child.try_wait().expect("a state") {
            let code = status.code();
            assert!(matches!(code, Some(0 | 3)), "seed {seed}: exit code {code:?}");
            return true;
        }
        let now = mark();
        events += usize::from(now != last);
        last = now;
        match death {
            Death::After(time) if begin.elapsed() >= *time => break,
            Death::Events(count, moment) if events >= *count => {
                std::thread::sleep(*moment);
                break;
            }
            _ => std::thread::sleep(Duration::from_millis(1)),
        }
    }
    child.kill().expect("killed"); // SIGKILL: nothing is written any more
    child.wait().expect("gone");
    false
}

fn stats(folder: &Path) -> Value {
    let stats = Command::new(env!("CARGO_BIN_EXE_unscrew"))
        .current_dir(folder)
        .args(["stats", "out", "--json"])
        .output()
        .expect("statistics");
    serde_json::from_slice(&stats.stdout).expect("JSON")
}

/// The cell's maps: those that are at hand, or calibrated once, without kills: a capture that dies has its own test.
fn calibrated(folder: &Path) {
    match std::env::var_os("MAPS") {
        Some(maps) => {
            fs::create_dir(folder.join("maps")).expect("folder");
            for file in fs::read_dir(maps).expect("maps").map(|f| f.expect("a file").path()) {
                let name = file.file_name().expect("a name");
                fs::copy(&file, folder.join("maps").join(name)).expect("copied");
            }
        }
        None => {
            assert!(ended(folder, false, 2_999_999, &Death::Never));
            fs::remove_dir_all(folder.join("out")).expect("removed");
        }
    }
}

#[test]
#[ignore = "minutes: kills a run at random moments"]
fn no_action_is_repeated_or_lost_whenever_the_program_dies() {
    let number = |name: &str| std::env::var(name).ok().and_then(|k| k.parse::<usize>().ok());
    let kills = number("KILLS").unwrap_or(25);
    let folder = tempfile::tempdir().expect("folder");
    calibrated(folder.path());
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(9);
    let begin = Instant::now();
    let until = number("MINUTES").map(|m| begin + Duration::from_secs(60 * m as u64));
    let late = || until.is_some_and(|until| Instant::now() > until);
    let (mut killed, mut seed, mut actions) = (0, 3_000_000, 0);
    while killed < kills && !late() {
        let _ = fs::remove_dir_all(folder.path().join("out"));
        seed += 1;
        let mut resume = false;
        loop {
            let moment = Duration::from_micros(rng.random_range(0..30_000));
            let death = match rng.random_range(0..4) {
                _ if killed >= kills || late() => Death::Never,
                0 => Death::After(Duration::from_millis(rng.random_range(20..4000))),
                _ => Death::Events(rng.random_range(1..10), moment),
            };
            if ended(folder.path(), resume, seed, &death) {
                break;
            }
            killed += 1;
            resume = folder.path().join("out/journal.db").exists();
        }
        let stats = stats(folder.path());
        actions += stats["actions_total"].as_u64().unwrap_or_default();
        println!(
            "seed {seed}: {killed} kills so far, {actions} actions, {} repeated, {} lost; {:.1} s a kill",
            stats["actions_repeated"],
            stats["actions_lost"],
            begin.elapsed().as_secs_f64() / killed.max(1) as f64
        );
        assert_eq!(stats["units"], 2, "{stats}");
        assert_eq!(
            (&stats["actions_repeated"], &stats["actions_lost"]),
            (&Value::from(0), &Value::from(0)),
            "{stats}"
        );
    }
}

/// A disk of its own, in a name space of its own: needs `unshare` with user name spaces, as most Linux systems have it. In it the run is
/// started on a disk that is nearly full, is given room, and goes on.
#[test]
#[ignore = "minutes: fills a small disk"]
fn a_full_disk_stops_a_run_which_then_goes_on() {
    let folder = tempfile::tempdir().expect("folder");
    calibrated(folder.path());
    fs::create_dir(folder.path().join("out")).expect("folder");
    let script = r#"
        mount -t tmpfs -o size=64m none out || exit 77
        head -c $((64 * 1024 * 1024 - FREE_KIB * 1024)) /dev/zero > out/ballast
        "$UNSCREW" run --units 1 --out out --maps maps --seed 3000077 2> full.txt
        echo $? > full.code
        rm out/ballast
        "$UNSCREW" run --units 1 --out out --maps maps --seed 3000077 --resume 2> resumed.txt
        echo $? > resumed.code
        "$UNSCREW" stats out --json > stats.json"#;
    for free_kib in [2500, 12_000] {
        let status = Command::new("unshare")
            .args(["--user", "--map-root-user", "--mount", "sh", "-c", script])
            .current_dir(folder.path())
            .env("UNSCREW", env!("CARGO_BIN_EXE_unscrew"))
            .env("FREE_KIB", free_kib.to_string())
            .status();
        if !matches!(&status, Ok(status) if status.code() != Some(77)) {
            println!("not tested: no disk of its own to fill here ({status:?})");
            return;
        }
        let read = |name: &str| fs::read_to_string(folder.path().join(name)).expect(name);
        let said = read("full.txt");
        assert_eq!(read("full.code").trim(), "1", "{said}");
        assert!(said.contains("free") && said.contains("space"), "{said}");
        assert!(
            matches!(read("resumed.code").trim(), "0" | "3"),
            "{}",
            read("resumed.txt")
        );
        let stats: Value = serde_json::from_str(&read("stats.json")).expect("JSON");
        println!("{free_kib} KiB: {} / {} actions", said.trim(), stats["actions_total"]);
        assert_eq!(
            (&stats["units"], &stats["actions_repeated"], &stats["actions_lost"]),
            (&Value::from(1), &Value::from(0), &Value::from(0)),
            "{stats}"
        );
    }
}
