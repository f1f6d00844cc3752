//! What a crash, a full disk or a damaged one does to a run: it goes on without repeating or losing anything, or it refuses and says why.

mod fake;

use cell::device::DriveEnd;
use cell::journal::{JOURNAL_FILE, Journal, JournalError};
use cell::program::Program;
use cell::record::{Act, Event, Outcome};
use cell::run::{RunError, Runner, Silent};
use cell::seal::END_FILE;
use fake::{Fake, map};
use rand::{RngExt, SeedableRng};
use std::fs;
use std::path::Path;
use std::sync::Arc;

const WAL: &str = "journal.db-wal";

fn block_on<T>(future: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread().build();
    runtime.expect("runtime").block_on(future)
}

fn runner(fake: &Fake, journal: Journal) -> Runner {
    let program = Program::paper().expect("built-in program");
    let maps = vec![map_once().clone()];
    let finder = Arc::new(fake.clone());
    let runner = Runner::new(fake.devices(), finder, maps, program, fake::config(), journal).expect("runner");
    runner.start().expect("started");
    runner
}

fn map_once() -> &'static calibration::Map {
    static MAP: std::sync::OnceLock<calibration::Map> = std::sync::OnceLock::new();
    MAP.get_or_init(map)
}

/// Runs until the program dies in a call, and leaves in `folder` what a killed process leaves: no last checkpoint, no tidy end.
fn killed(fake: &Fake, folder: &Path) -> bool {
    let alive = tempfile::tempdir().expect("folder");
    let ended = block_on(async {
        let mut runner = runner(fake, Journal::open(alive.path()).expect("journal"));
        let ended = tokio::select! {
            ended = runner.run_unit(&Silent) => { ended.expect("a record"); true },
            () = fake.1.notified() => false,
        };
        for file in [JOURNAL_FILE, WAL, END_FILE] {
            fs::copy(alive.path().join(file), folder.join(file)).expect("copied");
        }
        ended
    });
    fake.world().die_at = None;
    ended
}

fn go_on(fake: &Fake, folder: &Path) -> Result<(), RunError> {
    let journal = Journal::open(folder)?;
    block_on(runner(fake, journal).resume_unit(&Silent)).map(|_| ())
}

/// Every screw was driven at once and is out.
fn nothing_repeated_or_lost(fake: &Fake, why: &str) {
    let bursts: Vec<usize> = fake.world().faces.values().flatten().map(|h| h.bursts).collect();
    assert_eq!(
        (bursts, fake.standing()),
        (vec![1; 10], 0),
        "{why}: {:?}",
        fake.world().log
    );
}

#[test]
fn whatever_call_the_program_dies_in_nothing_is_repeated_or_lost() {
    let mut deaths = 0;
    for call in ["move", "drive", "job"] {
        // every burst and every job, and every seventh of the many moves
        for n in (1..).step_by(if call == "move" { 7 } else { 1 }) {
            let mut ended = true;
            for took_effect in [false, true] {
                let (fake, folder) = (Fake::whole(), tempfile::tempdir().expect("folder"));
                fake.world().die_at = Some((call, n, took_effect));
                ended = killed(&fake, folder.path());
                if ended {
                    break;
                }
                deaths += 1;
                let why = format!("{call} {n} {took_effect}");
                go_on(&fake, folder.path()).unwrap_or_else(|e| panic!("{why}: {e}"));
                nothing_repeated_or_lost(&fake, &why);
                let record = Journal::open_read_only(folder.path())
                    .expect("journal")
                    .unit(1)
                    .expect("read");
                assert_eq!(record.expect("unit").outcome, Some(Outcome::Ok), "{why}");
            }
            if ended {
                break;
            }
        }
    }
    assert!(deaths > 30, "{deaths}");
}

#[test]
fn a_full_disk_stops_the_run_before_the_act_and_it_goes_on_when_there_is_room() {
    let (mut full, mut room) = (0, 0);
    while full < 1000 {
        let (fake, folder) = (Fake::whole(), tempfile::tempdir().expect("folder"));
        let journal = Journal::open(folder.path()).expect("journal");
        journal.limit_pages(room).expect("limited");
        room += 1;
        let Err(error) = block_on(runner(&fake, journal).run_unit(&Silent)) else {
            break;
        };
        full += 1;
        let said = error.to_string();
        assert!(said.contains("the disk is full") && said.contains("--resume"), "{said}");
        // nothing was driven that was not written down before
        let intents: usize = match Journal::open_read_only(folder.path()).expect("journal").events(1) {
            Ok(events) => events
                .iter()
                .filter(|e| matches!(e.1, Event::Intent { act: Act::Drive { .. } }))
                .count(),
            Err(e) => panic!("{e}"),
        };
        assert!(fake.calls("drive") <= intents, "{} of {intents}", fake.calls("drive"));
        let begun = Journal::open_read_only(folder.path())
            .expect("journal")
            .unfinished()
            .expect("read")
            .is_some();
        go_on(&fake, folder.path()).expect("gone on");
        if begun {
            nothing_repeated_or_lost(&fake, "full disk");
        }
    }
    assert!(full >= 5, "{full} sizes were too small");
}

/// What was done to a copy of what a killed process left, and whether it has to be refused.
struct Harm {
    name: String,
    refused: bool,
}

#[test]
fn a_damaged_journal_is_proven_or_refused() {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(5);
    let crash = || {
        let (fake, folder) = (Fake::whole(), tempfile::tempdir().expect("folder"));
        fake.world().die_at = Some(("drive", 6, true));
        assert!(!killed(&fake, folder.path()));
        (fake, folder)
    };
    let (mut fake, mut left) = crash();
    let (mut refused, mut went_on) = (0, 0);
    let mut harms: Vec<(u32, usize)> = [0, 1, 2, 3, 4, 5]
        .iter()
        .flat_map(|kind| (0..4).map(|k| (*kind, k)))
        .collect();
    harms.extend((0..20).map(|k| (6, k)));
    harms.extend((0..30).map(|k| (7, k)));
    for (kind, k) in harms {
        let at = tempfile::tempdir().expect("folder");
        for file in [JOURNAL_FILE, WAL, END_FILE] {
            fs::copy(left.path().join(file), at.path().join(file)).expect("copied");
        }
        let harm = harmed(at.path(), kind, k, &mut rng);
        match go_on(&fake, at.path()) {
            Ok(()) => {
                assert!(!harm.refused, "{} was not seen", harm.name);
                nothing_repeated_or_lost(&fake, &harm.name);
                went_on += 1;
                (fake, left) = crash();
            }
            Err(RunError::Journal(error)) => {
                let said = error.to_string();
                let advice = ["restore", "new folder", "new one"].iter().any(|a| said.contains(a));
                assert!(
                    advice || matches!(error, JournalError::Entry { .. }),
                    "{}: {said}",
                    harm.name
                );
                assert_eq!(fake.calls("drive"), 6, "{}: something was done", harm.name);
                refused += 1;
            }
            Err(other) => panic!("{}: {other}", harm.name),
        }
    }
    println!("{refused} refused, {went_on} went on");
    assert!(refused > 12 && went_on > 4);
}

fn harmed(at: &Path, kind: u32, k: usize, rng: &mut rand_pcg::Pcg64Mcg) -> Harm {
    const PAGE: usize = 4096;
    let (wal, db) = (at.join(WAL), at.join(JOURNAL_FILE));
    let harm = |name: String, refused| Harm { name, refused };
    // one file with everything in it, as after a tidy end
    let settle = || {
        drop(Journal::open(at).expect("journal"));
        assert!(!wal.exists());
        fs::read(&db).expect("read")
    };
    match kind {
        0 => {
            // the next commit was under way
            let mut bytes = fs::read(&wal).expect("read");
            let torn = bytes[32..32 + 1000 * (k + 1)].to_vec();
            bytes.extend(torn);
            fs::write(&wal, bytes).expect("written");
            harm(format!("torn tail {k}"), false)
        }
        1 => {
            let bytes = fs::read(&wal).expect("read");
            let cut = [1, PAGE, bytes.len() / 2, bytes.len() - 40][k];
            fs::write(&wal, &bytes[..bytes.len() - cut]).expect("written");
            harm(format!("wal cut by {cut}"), true)
        }
        2 => {
            fs::remove_file(&wal).expect("removed");
            harm("wal gone".into(), true)
        }
        3 => {
            let mut bytes = settle();
            let last = bytes.len() - PAGE;
            bytes[last..].fill([0, 0xa5][k % 2]);
            fs::write(&db, bytes).expect("written");
            harm(format!("last page filled {k}"), false)
        }
        4 => {
            let bytes = settle();
            fs::write(&db, &bytes[..bytes.len() - PAGE * (k + 1)]).expect("written");
            harm(format!("cut by {} pages", k + 1), true)
        }
        5 => {
            // the end mark alone is lost or torn: the journal proves itself
            match k % 2 {
                0 => fs::remove_file(at.join(END_FILE)).expect("removed"),
                _ => fs::write(at.join(END_FILE), "0000000").expect("written"),
            }
            harm(format!("no end mark {k}"), false)
        }
        6 => {
            let mut bytes = settle();
            let place = bytes.len() - 1 - rng.random_range(0..PAGE);
            bytes[place] ^= 1 << rng.random_range(0..8);
            fs::write(&db, bytes).expect("written");
            harm(format!("bit in the last page, byte {place}"), false)
        }
        _ => {
            let mut bytes = settle();
            let place = rng.random_range(PAGE..bytes.len());
            bytes[place] = bytes[place].wrapping_add(rng.random_range(1..=255));
            fs::write(&db, bytes).expect("written");
            harm(format!("byte {place}"), false)
        }
    }
}

#[test]
fn an_event_that_was_altered_is_seen() {
    let folder = tempfile::tempdir().expect("folder");
    let mut journal = Journal::open(folder.path()).expect("journal");
    let unit = journal.begin_unit(0.0).expect("unit");
    journal.append(unit, 1.0, &Event::Arrived).expect("event");
    let driven = Event::Driven {
        found: 3,
        arm: "arm_a".into(),
        burst: cell::record::Burst {
            program: None,
            end: Some(DriveEnd::Removed),
            error: None,
            aim: geometry::Point::new(1.0, 2.0, 3.0),
            second_look: None,
            places_left: None,
            time_s: 1.0,
        },
    };
    journal.append(unit, 2.0, &driven).expect("event");
    drop(journal);
    let path = folder.path().join(JOURNAL_FILE);
    let mut bytes = fs::read(&path).expect("read");
    let at = bytes.windows(9).rposition(|w| w == b"\"found\":3").expect("there");
    bytes[at + 8] = b'4';
    fs::write(&path, bytes).expect("written");
    let journal = Journal::open(folder.path()).expect("journal");
    let error = journal.events(unit).expect_err("altered").to_string();
    assert!(error.contains("not whole") && error.contains("event 2"), "{error}");
}
