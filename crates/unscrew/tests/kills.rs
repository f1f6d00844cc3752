//! Kills the program at random moments, lets it go on, and asks journal and world whether anything was done twice or lost.
//!
//! `KILLS=300 cargo test --release -p unscrew --test kills -- --ignored`: about eight seconds a kill.

use rand::{RngExt, SeedableRng};
use serde_json::Value;
use std::{
    path::Path,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

/// Starts or goes on with a run; `true` once it has ended by itself, `false` if it was killed after `limit`.
fn ended(folder: &Path, resume: bool, seed: u64, limit: Duration) -> bool {
    let mut command = Command::new(env!("CARGO_BIN_EXE_unscrew"));
    command.current_dir(folder).stdout(Stdio::null()).stderr(Stdio::null());
    command.args([
        "run",
        "--units",
        "2",
        "--out",
        "out",
        "--maps",
        "maps",
        "--seed",
        &seed.to_string(),
    ]);
    if resume {
        command.arg("--resume");
    }
    let mut child = command.spawn().expect("the program starts");
    let begin = Instant::now();
    while begin.elapsed() < limit {
        if let Some(status) = child.try_wait().expect("a state") {
            let code = status.code();
            assert!(matches!(code, Some(0 | 3)), "seed {seed}: exit code {code:?}");
            return true;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().expect("killed"); // SIGKILL: nothing is written any more
    child.wait().expect("gone");
    false
}

#[test]
#[ignore = "minutes: kills a run at random moments"]
fn no_action_is_repeated_or_lost_whenever_the_program_dies() {
    let kills: usize = std::env::var("KILLS").ok().and_then(|k| k.parse().ok()).unwrap_or(25);
    let folder = tempfile::tempdir().expect("folder");
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(9);
    let (mut killed, mut seed) = (0, 3_000_000);
    while killed < kills {
        let _ = std::fs::remove_dir_all(folder.path().join("out"));
        seed += 1;
        // the cell is calibrated once, without kills: a capture that dies has its own test
        let mut resume = folder.path().join("maps").exists();
        if !resume {
            assert!(ended(folder.path(), false, seed, Duration::from_secs(600)));
            let _ = std::fs::remove_dir_all(folder.path().join("out"));
            seed += 1;
        }
        resume = false;
        while !ended(
            folder.path(),
            resume,
            seed,
            Duration::from_millis(rng.random_range(600..16_000)),
        ) {
            killed += 1;
            resume = folder.path().join("out/journal.db").exists();
        }
        let stats = Command::new(env!("CARGO_BIN_EXE_unscrew"))
            .current_dir(folder.path())
            .args(["stats", "out", "--json"])
            .output()
            .expect("statistics");
        let stats: Value = serde_json::from_slice(&stats.stdout).expect("JSON");
        println!(
            "seed {seed}: {killed} kills so far, {} actions, {} repeated, {} lost",
            stats["actions_total"], stats["actions_repeated"], stats["actions_lost"]
        );
        assert_eq!(stats["units"], 2, "{stats}");
        assert_eq!(
            (&stats["actions_repeated"], &stats["actions_lost"]),
            (&Value::from(0), &Value::from(0)),
            "{stats}"
        );
    }
}
