//! Training as its users meet it: the same file for the same settings, also after a stop; damage is named.

use std::{fs, path::Path};
use training::{Progress, TrainError, TrainSettings, train};

struct Silent;
impl Progress for Silent {
    fn report(&self, _: &str, _: u64, _: u64, _: Option<f32>) {}
}

fn tiny(work: Option<&Path>) -> TrainSettings {
    TrainSettings {
        units: 1,
        background: 1,
        batch: 8,
        coarse_steps: 4,
        fine_steps: 4,
        close_steps: 4,
        mining_faces: 1,
        tuning_faces: 0,
        work: work.map(Path::to_owned),
        data: Path::new(env!("CARGO_MANIFEST_DIR")).join("data"),
        ..TrainSettings::default()
    }
}

#[test]
fn a_training_that_was_stopped_ends_with_the_same_bytes() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let (work, out) = (folder.path().join("work"), folder.path().join("model.unscrew"));
    fs::create_dir(&work)?;
    train(&tiny(None), &out, &Silent)?;
    let in_one_go = fs::read(&out)?;
    let report = train(&tiny(Some(&work)), &out, &Silent)?;
    assert_eq!(fs::read(&out)?, in_one_go);
    // as a stop leaves it: stage 2 not gone on with after mining, one unit's patches not yet written
    let gone: Vec<_> = fs::read_dir(&work)?
        .filter_map(Result::ok)
        .filter(|f| {
            f.file_name()
                .to_str()
                .is_some_and(|n| n.starts_with("fine0") || n.ends_with(".patches"))
        })
        .collect();
    assert_eq!(gone.len(), 2, "{gone:?}");
    for file in gone {
        fs::remove_file(file.path())?;
    }
    let again = train(&tiny(Some(&work)), &out, &Silent)?;
    assert_eq!(fs::read(&out)?, in_one_go);
    let mined: usize = again
        .patches
        .iter()
        .filter(|p| p.0.starts_with("mined"))
        .map(|p| p.1)
        .sum();
    assert!(mined > 0); // a network of three steps misses every screw
    assert_eq!(fs::read_to_string(work.join("mined.jsonl"))?.lines().count(), mined);
    assert_eq!(again.loss, report.loss);
    assert!(
        again.loss.len() == 4 && again.loss.values().all(|l| l.is_finite()),
        "{:?}",
        again.loss
    );
    Ok(())
}

#[test]
fn a_damaged_work_folder_is_named() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("model.unscrew");
    for name in ["unit-000000-1.patches", "coarse"] {
        train(&tiny(Some(folder.path())), &out, &Silent)?;
        let file = fs::read_dir(folder.path())?
            .filter_map(Result::ok)
            .find(|f| f.file_name().to_string_lossy().starts_with(name))
            .ok_or("the file is there")?;
        fs::write(file.path(), b"not what training wrote")?;
        match train(&tiny(Some(folder.path())), &out, &Silent) {
            Err(TrainError::Damaged { path }) => assert_eq!(path, file.path()),
            other => return Err(format!("{name}: {other:?}").into()),
        }
        fs::remove_file(file.path())?;
    }
    Ok(())
}

#[test]
fn pictures_with_truth_are_learned_from_or_named() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let (out, pictures) = (folder.path().join("model.unscrew"), folder.path().join("pictures"));
    let settings = TrainSettings {
        pictures: Some(pictures.clone()),
        ..tiny(None)
    };
    assert!(
        matches!(train(&settings, &out, &Silent), Err(TrainError::Data { path, .. }) if path == pictures.join("truth"))
    );
    fs::create_dir_all(pictures.join("truth"))?;
    fs::create_dir(pictures.join("rgb"))?;
    let sheet = geometry::RgbImage::from_pixel(300, 200, image::Rgb([150; 3]));
    geometry::write_jpeg(&pictures.join("rgb/a.jpg"), &sheet, 90)?;
    let truth = pictures.join("truth/a.json");
    fs::write(
        &truth,
        r#"{"rgb":"rgb/a.jpg","screws":[{"u":100,"v":90,"head_d_px":28,"detectable":true},{"u":40,"v":40,"head_d_px":28,"detectable":false}],
            "negatives":[{"kind":"slotted","u":200,"v":90,"d_px":30},{"kind":"rivet","u":200,"v":20,"d_px":30,"visible":false}]}"#,
    )?;
    let report = train(&settings, &out, &Silent)?;
    let counted = |kind: &str| report.patches.get(kind).copied();
    assert_eq!(counted("pictured cross screws"), Some(1));
    assert_eq!(counted("pictured other fasteners"), Some(1));
    assert_eq!(counted("pictured other features"), None);
    assert_eq!(counted("pictured background"), Some(12));
    fs::write(&truth, r#"{"rgb":"rgb/a.jpg","screws":[{"u":100}],"negatives":[]}"#)?;
    assert!(matches!(train(&settings, &out, &Silent), Err(TrainError::Truth { path, .. }) if path == truth));
    Ok(())
}

#[test]
fn a_model_that_is_gone_on_with_keeps_its_networks() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let (from, out) = (folder.path().join("from.unscrew"), folder.path().join("model.unscrew"));
    let graphs = |path: &Path| -> Result<Vec<Vec<u8>>, Box<dyn std::error::Error>> {
        let (networks, _) = vision::decode_model(&fs::read(path)?, "a model")?;
        let graph = |(_, bytes)| Ok(nn::onnx::export(&nn::Network::from_bytes(bytes)?));
        networks.named().into_iter().map(graph).collect()
    };
    let (networks, settings) = vision::decode_model(vision::EMBEDDED_MODEL, "embedded")?;
    let without = vision::Networks {
        close: None,
        ..networks.clone()
    };
    let nothing_to_learn = TrainSettings {
        coarse_steps: 0,
        fine_steps: 0,
        close_steps: 0,
        mining_faces: 0,
        from: Some(from.clone()),
        ..tiny(None)
    };
    for networks in [&networks, &without] {
        fs::write(&from, vision::encode_model(networks, &settings)?)?;
        train(&nothing_to_learn, &out, &Silent)?;
        assert_eq!(graphs(&out)?, graphs(&from)?);
    }
    // what looks closer begins as the first of those that it looks closer than
    let closer = TrainSettings {
        close_steps: 2,
        ..nothing_to_learn
    };
    let report = train(&closer, &out, &Silent)?;
    assert!(report.loss["close"] < 1.0, "{:?}", report.loss); // 1.9 and more from the start
    let (after, before) = (graphs(&out)?, graphs(&from)?);
    assert_eq!(after[..2], before);
    assert!(after.len() == 3 && after[2] != after[1]);
    Ok(())
}
