//! A recorded unit decided again: the same with the same, and what another model, map or policy would have changed.

mod fake;

use calibration::Map;
use cell::basis::{ArmParts, Basis};
use cell::config::CellConfig;
use cell::device::DriveEnd;
use cell::journal::Journal;
use cell::look::Judge;
use cell::program::Program;
use cell::replay::{Kind, Look, Stepped, UnitReplay};
use cell::run::{Runner, Silent};
use fake::{Fake, PixelFinder, map, map_that_is_off, screw_that_ends};
use std::path::Path;
use std::sync::Arc;

fn block_on<T>(future: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread().build();
    runtime.expect("runtime").block_on(future)
}

/// Two screws a face, one of which the bit misses at first; and one that stands though the driver says it is out.
fn recorded(folder: &Path, keep_frames: bool) {
    let fake = Fake::whole();
    let missed = screw_that_ends(40.0, -120.0, &[DriveEnd::MissedHead]);
    fake.world().faces.get_mut("front").expect("a face").push(missed);
    fake.world().lie_at_burst = Some(2);
    let mut config = fake::config();
    config.journal.keep_frames = keep_frames;
    let program = Program::paper().expect("built-in program");
    let map_file = folder.join("map.json");
    map().save(&map_file).expect("saved");
    let arms = ["arm_a", "arm_b"].map(|name| ArmParts {
        name,
        map: (name == "arm_a").then_some(&map_file),
        drives: name == "arm_a",
    });
    let basis = Basis::keep(folder, ("pixels", None), &arms, &config, &program).expect("kept");
    let mut journal = Journal::open(folder).expect("journal");
    journal.begin_start(&basis).expect("written");
    journal.begin_start(&basis).expect("said once");
    assert_eq!(journal.starts().expect("starts"), [(0, basis)]);
    let finder = Arc::new(PixelFinder::default());
    let runner = Runner::new(fake.devices(), finder, vec![map()], program, config, journal);
    let mut runner = runner.expect("runner");
    runner.start().expect("started");
    let record = block_on(runner.run_unit(&Silent)).expect("a record");
    assert_eq!(fake.standing(), 0, "{:?}: {:?}", record.outcome, fake.world().log);
}

/// Decides everything again; returns the looks and how many had no frame.
fn replayed(folder: &Path, finder: PixelFinder, other: Option<Map>, change: fn(&mut CellConfig)) -> (Vec<Look>, usize) {
    let journal = Journal::open_read_only(folder).expect("journal");
    let (_, basis) = journal.starts().expect("starts").pop().expect("one");
    let mut maps = basis.maps(folder).expect("maps");
    if other.is_some() {
        maps[0] = other;
    }
    let mut config = basis.config(folder).expect("cell file");
    change(&mut config);
    let program = basis.program(folder).expect("program");
    let motions = basis.motions(&config);
    let judge = Judge {
        finder: &finder,
        reaches: basis.reaches(&maps, &motions),
        config: &config,
    };
    let mut unit = UnitReplay::new(folder, 1);
    let (mut looks, mut without) = (Vec::new(), 0);
    for entry in journal.entries(1).expect("events") {
        match unit.step(&judge, &program, &entry).expect("replayed") {
            Stepped::NoLook => {}
            Stepped::NoFrame => without += 1,
            Stepped::Look(look) => looks.push(*look),
        }
    }
    (looks, without)
}

#[test]
fn the_same_gives_the_same_and_another_says_what_it_changes() {
    let folder = tempfile::tempdir().expect("folder");
    recorded(folder.path(), true);
    let same = |_: &mut CellConfig| {};
    let (looks, without) = replayed(folder.path(), PixelFinder::default(), None, same);
    assert!(
        looks.iter().all(|l| l.same && l.changes == Default::default()),
        "{looks:#?}"
    );
    assert_eq!(without, 0);
    for kind in [Kind::Face, Kind::SecondLook, Kind::Check] {
        assert!(looks.iter().any(|l| l.kind == kind), "{kind:?}");
    }
    let faces = looks.iter().filter(|l| l.kind == Kind::Face).count();

    let (other, _) = replayed(folder.path(), PixelFinder::default(), Some(map_that_is_off(1.5)), same);
    let moved: Vec<f64> = other
        .iter()
        .flat_map(|l| &l.changes.moved)
        .map(|m| m.moved_mm)
        .collect();
    assert!(
        moved.len() > 10 && moved.iter().all(|mm| (mm - 1.5).abs() < 0.01),
        "{moved:?}"
    );
    assert!(
        other
            .iter()
            .all(|l| l.changes.screws_lost.is_empty() && l.changes.targets_lost.is_empty())
    );

    let (blind, _) = replayed(folder.path(), PixelFinder { overlooks: 1 }, None, same);
    let lost: usize = blind.iter().map(|l| l.changes.screws_lost.len()).sum();
    assert_eq!(lost, faces, "one a face");
    assert!(blind.iter().any(|l| l.kind == Kind::SecondLook && !l.same));

    let strict = |config: &mut CellConfig| config.exclusion.face_tilt_max_rad = -1.0;
    let (excluded, _) = replayed(folder.path(), PixelFinder::default(), None, strict);
    let out = excluded.iter().filter_map(|l| l.changes.excluded.as_ref());
    assert!(out.clone().count() > 0);
    assert!(
        out.clone()
            .all(|e| e.was.is_none() && e.is.as_ref().is_some_and(|is| is.contains("leans")))
    );
}

#[test]
fn what_was_not_kept_is_said() {
    let folder = tempfile::tempdir().expect("folder");
    recorded(folder.path(), false);
    let (looks, without) = replayed(folder.path(), PixelFinder::default(), None, |_| {});
    assert!(looks.is_empty() && without > 8);
    assert!(!folder.path().join(cell::frames::FRAME_FOLDER).exists());
}
