//! Packs the real photographs that training needs into `crates/training/data`: run once, when the sources change.
//!
//! `cargo run --release -p training --example pack_real -- SOURCES`, where SOURCES holds `ewaste_patches` and `appliance_scenes`.

use image::{RgbImage, codecs::jpeg::JpegEncoder, imageops};
use std::{collections::BTreeMap, error::Error, fs, path::Path};

/// Scenes that are learned from. Every other scene is held out, and no object is on both sides.
const TRAINING_SCENES: [&str; 11] = [
    "IMG_7863",
    "IMG_7864",
    "IMG_7865",
    "IMG_7866",
    "IMG_7867",
    "IMG_7868",
    "IMG_7869",
    "RandomAssortment",
    "harddrive",
    "harddrive_vert",
    "uuid_3782be52",
];
/// Photographs kept of each scene: most are the same with other colours.
const PER_SCENE: usize = 5;
/// Crops along a row of an atlas.
const COLUMNS: usize = 50;

fn main() -> Result<(), Box<dyn Error>> {
    let sources = std::env::args().nth(1).ok_or("give the folder of the sources")?;
    let sources = Path::new(&sources);
    let data = Path::new("crates/training/data");
    fs::create_dir_all(data.join("photographs"))?;
    crops(&sources.join("ewaste_patches"), data)?;
    photographs(&sources.join("appliance_scenes"), &data.join("photographs"))
}

fn crops(from: &Path, data: &Path) -> Result<(), Box<dyn Error>> {
    let manifest = fs::read_to_string(from.join("manifest.csv"))?;
    let mut classes: BTreeMap<&str, Vec<(&str, &str)>> = BTreeMap::new();
    for line in manifest.lines().skip(1) {
        let mut fields = line.split(',');
        if let (Some(file), Some(class), Some(group)) = (fields.next(), fields.next(), fields.next()) {
            classes.entry(class).or_default().push((file, group));
        }
    }
    let mut index = String::from("class,tile,group\n");
    for (class, files) in classes {
        let rows = files.len().div_ceil(COLUMNS);
        let mut atlas = RgbImage::new(64 * COLUMNS as u32, 64 * rows as u32);
        for (k, (file, group)) in files.iter().enumerate() {
            let crop = image::open(from.join(file))?.to_rgb8();
            imageops::replace(&mut atlas, &crop, 64 * (k % COLUMNS) as i64, 64 * (k / COLUMNS) as i64);
            index.push_str(&format!("{class},{k},{group}\n"));
        }
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, 92).encode_image(&atlas)?;
        fs::write(data.join(format!("ewaste_{class}.jpg")), bytes)?;
    }
    fs::write(data.join("ewaste.csv"), index)?;
    Ok(())
}

fn photographs(from: &Path, to: &Path) -> Result<(), Box<dyn Error>> {
    let manifest = fs::read_to_string(from.join("manifest.csv"))?;
    let mut kept: BTreeMap<&str, usize> = BTreeMap::new();
    let mut index = String::from("file,scene\n");
    for line in manifest.lines().skip(1) {
        let mut fields = line.split(',');
        let (Some(file), Some(scene)) = (fields.next(), fields.next()) else {
            continue;
        };
        let count = kept.entry(scene).or_default();
        if !TRAINING_SCENES.contains(&scene) || *count == PER_SCENE {
            continue;
        }
        let stem = file.strip_suffix(".jpg").ok_or("expected JPEG files")?;
        let name = format!("{scene}_{count}");
        for (folder, from_file, extension) in [
            ("images", file.to_owned(), "jpg"),
            ("labels", format!("{stem}.txt"), "txt"),
        ] {
            fs::create_dir_all(to.join(folder))?;
            fs::copy(
                from.join(folder).join(from_file),
                to.join(folder).join(format!("{name}.{extension}")),
            )?;
        }
        index.push_str(&format!("{name}.jpg,{scene}\n"));
        *count += 1;
    }
    fs::write(to.join("manifest.csv"), index)?;
    Ok(())
}
