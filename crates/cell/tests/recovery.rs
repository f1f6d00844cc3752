//! What the cell does about what goes wrong: other bits, a person's clicks, the mill and who lets it, a hold, an open safety chain.

mod fake;

use cell::config::CellConfig;
use cell::device::DriveEnd;
use cell::journal::Journal;
use cell::packml::{Command, State};
use cell::policy::{Choice, Destructive, Target};
use cell::program::Program;
use cell::record::{Assist, Method, NgReason, Outcome, Purpose, UnitRecord};
use cell::run::{RunError, Runner, Silent};
use fake::{Fake, map, screw, screw_that_ends, started};
use std::path::Path;
use std::sync::Arc;

fn block_on<T>(future: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    runtime.expect("runtime").block_on(future)
}

fn runner(fake: &Fake, folder: &Path, change: impl FnOnce(&mut CellConfig)) -> Runner {
    let mut config = fake::config();
    change(&mut config);
    Runner::new(
        fake.devices(),
        Arc::new(fake.clone()),
        vec![map()],
        Program::paper().expect("built-in program"),
        config,
        Journal::open(folder).expect("journal"),
    )
    .expect("runner")
}

fn run(fake: &Fake, change: impl FnOnce(&mut CellConfig)) -> UnitRecord {
    let folder = tempfile::tempdir().expect("folder");
    let mut runner = runner(fake, folder.path(), change);
    runner.start().expect("started");
    let record = block_on(runner.run_unit(&Silent)).expect("a record");
    let read = runner.journal().unit(record.unit).expect("journal").expect("the unit");
    assert_eq!(read, record, "the record is what the journal adds up to");
    record
}

fn mills(config: &mut CellConfig) {
    config.destructive.mill = true;
}

#[test]
fn a_worn_recess_is_pressed_harder_and_then_met_with_another_bit() {
    let slips = [DriveEnd::CamOut; 3];
    let fake = Fake::new(&[("front", vec![screw_that_ends(0.0, 0.0, &slips), screw(100.0, 0.0)])]);
    let record = run(&fake, |_| {});
    assert_eq!(record.outcome, Some(Outcome::Ok));
    assert_eq!((record.assist, record.method), (Assist::None, Method::NonDestructive));
    let done = fake.entries(&["drive", "MOUNT"]);
    let first = done.iter().position(|d| d == "MOUNT_EXTRACTOR").expect("the other bit");
    assert!(done[first + 1].starts_with("drive front 250 N"), "{done:?}");
    // the next screw is begun with the cross bit again
    let after = done.iter().position(|d| d == "MOUNT_CROSS");
    assert!(after.is_none_or(|k| k > first), "{done:?}");
    assert_eq!(fake.standing(), 0);
}

#[test]
fn nothing_is_milled_unless_everything_allows_it() {
    let seized = [DriveEnd::Seized; 5];
    let on = |face: &'static str, permitted: bool, change: fn(&mut CellConfig)| {
        let fake = Fake::new(&[
            ("front", vec![screw(90.0, 0.0)]),
            (face, vec![screw_that_ends(0.0, 0.0, &seized)]),
        ]);
        fake.world().mill_permitted = permitted;
        let record = run(&fake, change);
        let decided = record.attempts().find_map(|a| a.decision.clone()).expect("a decision");
        let milled = fake.entries(&["MOUNT_MILL"]).len();
        assert_eq!(decided.choice == Choice::Mill, milled == 1, "{decided:?}");
        (record, decided)
    };
    let (record, decided) = on("top", true, mills);
    assert_eq!(record.outcome, Some(Outcome::Ok));
    assert_eq!(record.method, Method::Destructive);
    assert_eq!(decided.path.len(), 3, "the way of the cutter is in the record");
    assert!(decided.path[1].distance_mm(decided.path[2]) <= 8.0);

    for (face, permitted, change, word) in [
        ("top", true, (|_| {}) as fn(&mut CellConfig), "cell file"),
        ("top", false, mills, "controller"),
        ("front_inner", true, mills, "cables"),
    ] {
        let (record, decided) = on(face, permitted, change);
        let seized = matches!(
            record.outcome,
            Some(Outcome::Ng {
                reason: NgReason::ScrewSeized,
                ..
            })
        );
        assert!(
            seized && record.method == Method::NonDestructive,
            "{:?}",
            record.outcome
        );
        assert_eq!(decided.choice, Choice::Reject);
        assert!(decided.because.contains(word), "{}", decided.because);
    }
    // parts are used again and a person is cheaper than the hole
    let (_, decided) = on("top", true, |config| {
        config.destructive = Destructive {
            mill: true,
            target: Target::Reuse,
            ..Destructive::default()
        };
        config.help.hand = true;
    });
    assert_eq!(decided.choice, Choice::Person, "{}", decided.because);
}

#[test]
fn a_person_clicks_on_what_the_detector_does_not_see() {
    let unseen = || {
        let mut hidden = screw(60.0, 40.0);
        hidden.verdict = vision::Verdict::Other;
        Fake::new(&[("front", vec![screw(-100.0, 0.0), hidden])])
    };
    let alone = run(&unseen(), |_| {});
    assert!(matches!(alone.outcome, Some(Outcome::Ng { .. })), "{:?}", alone.outcome);

    let fake = unseen();
    fake.world().clicks.insert("front".into(), vec![[60.0, 40.0]]);
    let helped = run(&fake, |config| config.help.click = true);
    assert_eq!(helped.outcome, Some(Outcome::Ok));
    assert_eq!((helped.assist, fake.standing()), (Assist::Remote, 0));
    assert!(helped.faces.iter().any(|f| f.purpose == Purpose::Clicked));
    assert!(helped.times.waiting_s > 0.0 || helped.looks.len() > 1);
}

/// Finds the heads of the front where they are not.
struct Aside(Fake, f64);

impl cell::run::Finder for Aside {
    fn find(&self, frame: &geometry::RgbdFrame, odds: f64) -> Result<Vec<vision::Screw>, cell::device::DeviceError> {
        let mut found = self.0.find(frame, odds)?;
        let on_front = self.0.world().presented == "front";
        for screw in found.iter_mut().filter(|_| on_front) {
            screw.pixel.u_px += self.1;
            let aside_mm = self.1 * frame.camera.map_or(1.0, |camera| camera.pixel_mm(1500.0));
            screw.camera = screw
                .camera
                .map(|p| geometry::Point::new(p.x_mm() + aside_mm, p.y_mm(), p.z_mm()));
        }
        Ok(found)
    }
    fn model(&self) -> String {
        "aside".into()
    }
}

#[test]
fn a_person_shows_where_a_screw_is_that_the_bit_does_not_meet() {
    let unmet = || Fake::new(&[("front", vec![screw(60.0, 40.0)])]);
    let run = |fake: &Fake, click: bool| {
        let folder = tempfile::tempdir().expect("folder");
        let mut config = fake::config();
        config.help.click = click;
        let mut runner = started(fake, folder.path(), Aside(fake.clone(), 2.2), map(), config);
        block_on(runner.run_unit(&Silent)).expect("a record")
    };
    let alone = run(&unmet(), false);
    assert!(
        matches!(
            &alone.outcome,
            Some(Outcome::Ng {
                reason: NgReason::ScrewMissed,
                ..
            })
        ),
        "{:?}",
        alone.outcome
    );
    let looks = alone.faces.iter().filter(|f| f.face.0 == "front");
    let tried: Vec<(Purpose, bool)> = looks
        .flat_map(|f| f.attempts.iter().map(|a| (f.purpose, a.searched())))
        .collect();
    assert_eq!(
        tried,
        [(Purpose::Work, false), (Purpose::Missed, true)],
        "searched around once, when its cover has stayed"
    );

    let fake = unmet();
    fake.world().clicks.insert("front".into(), vec![[60.0, 40.0]]);
    let helped = run(&fake, true);
    assert_eq!((helped.outcome, fake.standing()), (Some(Outcome::Ok), 0));
    assert_eq!(helped.assist, Assist::Remote);
}

#[test]
fn a_cell_that_nobody_started_moves_nothing() {
    let fake = Fake::whole();
    let folder = tempfile::tempdir().expect("folder");
    let mut runner = runner(&fake, folder.path(), |_| {});
    let error = block_on(runner.run_unit(&Silent)).expect_err("not started");
    assert!(
        matches!(
            error,
            RunError::NotExecuting {
                state: State::Stopped,
                ..
            }
        ),
        "{error}"
    );
    assert!(fake.world().log.is_empty() && fake.world().poses.is_empty());
}

#[test]
fn an_open_safety_chain_aborts_and_a_start_of_its_own_goes_on_with_the_unit() {
    let fake = Fake::whole();
    fake.world().unsafe_at_burst = Some(3);
    let folder = tempfile::tempdir().expect("folder");
    let mut runner = runner(&fake, folder.path(), |_| {});
    runner.start().expect("started");
    let error = block_on(runner.run_unit(&Silent)).expect_err("aborted");
    assert!(error.to_string().contains("Aborted (9)"), "{error}");
    let moves = fake.world().poses.len();

    // the chain is closed again: by itself nothing moves
    fake.world().safe = true;
    assert!(block_on(runner.resume_unit(&Silent)).is_err());
    assert!(runner.start().is_err(), "it has to be cleared first");
    assert_eq!(fake.world().poses.len(), moves);

    {
        let machine = runner.machine();
        let mut machine = machine.lock().expect("machine");
        machine.command(Command::Clear).expect("legal");
        machine.done();
    }
    runner.start().expect("started");
    let record = block_on(runner.resume_unit(&Silent))
        .expect("a record")
        .expect("the unit");
    assert_eq!((record.outcome.clone(), record.resumed), (Some(Outcome::Ok), 1));
    assert_eq!(fake.standing(), 0);
    assert_eq!(runner.journal().units().expect("units").len(), 1);
}

/// A person who asks for a hold when the first step begins.
struct HoldsAtOnce(Arc<std::sync::Mutex<cell::packml::Machine>>);

impl cell::run::Observer for HoldsAtOnce {
    fn step(&self, _: u64, step: usize, _: usize, _: &str) {
        if step == 0 {
            self.0.lock().expect("machine").command(Command::Hold).expect("legal");
        }
    }
}

#[test]
fn a_held_cell_waits_between_two_acts_and_goes_on() {
    let fake = Fake::whole();
    let folder = tempfile::tempdir().expect("folder");
    let mut runner = runner(&fake, folder.path(), |_| {});
    runner.start().expect("started");
    let machine = runner.machine();
    let person = async {
        let begin = std::time::Instant::now();
        while machine.lock().expect("machine").state() != State::Held {
            assert!(begin.elapsed().as_secs() < 10, "the hold is never met");
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
        }
        tokio::time::sleep(std::time::Duration::from_millis(150)).await;
        assert!(
            fake.entries(&["drive", "present"]).is_empty(),
            "nothing moves while it is held"
        );
        machine
            .lock()
            .expect("machine")
            .command(Command::Unhold)
            .expect("legal");
    };
    let observer = HoldsAtOnce(machine.clone());
    let (record, ()) = block_on(async { tokio::join!(runner.run_unit(&observer), person) });
    let record = record.expect("a record");
    assert_eq!(record.outcome, Some(Outcome::Ok));
    assert!(record.times.waiting_s > 0.0, "{:?}", record.times);
}
