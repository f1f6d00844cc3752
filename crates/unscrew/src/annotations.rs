//! Boxes of fasteners in the formats that other detectors are trained with: COCO and YOLO.

use anyhow::Result;
use serde_json::{Value, json};
use std::path::Path;
use vision::Drive;

/// Formats of annotations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// One file for all pictures, `annotations.json`: boxes in pixels.
    Coco,
    /// A text file a picture in `labels/`, boxes as shares of the picture, and `data.yaml` with the names of the classes.
    Yolo,
}

/// A fastener: the square around its head.
pub struct Fastener {
    /// What turns it: the class.
    pub drive: Drive,
    /// Centre, px: 0, 0 is the centre of the first pixel.
    pub center_px: [f64; 2],
    /// Side of the square, px.
    pub side_px: f64,
    /// Probability, of a find; none of a truth.
    pub score: Option<f64>,
    /// There, but nobody is expected to find it: a `crowd` of COCO, which neither finding nor missing is counted for; YOLO has no word for it.
    pub hidden: bool,
}

/// A picture and what is on it.
pub struct Picture {
    /// File name.
    pub file: String,
    /// Width and height, px.
    pub size_px: (u32, u32),
    /// What is on it.
    pub fasteners: Vec<Fastener>,
}

/// Place of a drive among the classes.
fn class(drive: Drive) -> usize {
    let known = Drive::KNOWN.iter().position(|d| *d == drive);
    known.unwrap_or(Drive::KNOWN.len())
}

/// Names of the classes, by number.
fn names() -> impl Iterator<Item = &'static str> {
    Drive::KNOWN.into_iter().chain([Drive::Unknown]).map(Drive::name)
}

impl Fastener {
    /// Left, top, right, bottom in pixel areas (0 is the left border of the first pixel), as far as they lie in the picture.
    fn bounds(&self, (width, height): (u32, u32)) -> [f64; 4] {
        let [u, v] = self.center_px.map(|c| c + 0.5);
        let half = 0.5 * self.side_px;
        let (width, height) = (f64::from(width), f64::from(height));
        [
            (u - half).clamp(0.0, width),
            (v - half).clamp(0.0, height),
            (u + half).clamp(0.0, width),
            (v + half).clamp(0.0, height),
        ]
    }
}

/// Writes the annotations of all pictures into a folder, each file aside and then renamed.
///
/// # Errors
/// A file that cannot be written, by its name.
pub fn write(folder: &Path, format: Format, pictures: &[Picture]) -> Result<()> {
    match format {
        Format::Coco => {
            let text = serde_json::to_string(&coco(pictures))?;
            geometry::write_aside(&folder.join("annotations.json"), text.as_bytes())?;
        }
        Format::Yolo => {
            let labels = folder.join("labels");
            crate::output::prepare_folder(&labels)?;
            for picture in pictures {
                let path = labels.join(Path::new(&picture.file).with_extension("txt"));
                geometry::write_aside(&path, yolo(picture).as_bytes())?;
            }
            let mut text = String::from("path: .\ntrain: images\nval: images\nnames:\n");
            for (k, name) in names().enumerate() {
                text += &format!("  {k}: {name}\n");
            }
            geometry::write_aside(&folder.join("data.yaml"), text.as_bytes())?;
        }
    }
    Ok(())
}

/// COCO's object detection format; class k has category k + 1.
fn coco(pictures: &[Picture]) -> Value {
    let images = pictures.iter().enumerate().map(|(k, p)| {
        let (width, height) = p.size_px;
        json!({"id": k + 1, "file_name": p.file, "width": width, "height": height})
    });
    let all = pictures
        .iter()
        .enumerate()
        .flat_map(|(k, p)| p.fasteners.iter().map(move |f| (k + 1, p.size_px, f)));
    let annotations = all.enumerate().map(|(k, (image, size_px, fastener))| {
        let [left, top, right, bottom] = fastener.bounds(size_px);
        let mut annotation = json!({
            "id": k + 1, "image_id": image, "category_id": class(fastener.drive) + 1, "iscrowd": u8::from(fastener.hidden),
            "bbox": [left, top, right - left, bottom - top], "area": (right - left) * (bottom - top),
        });
        if let Some(score) = fastener.score {
            annotation["score"] = json!(score);
        }
        annotation
    });
    let categories = names()
        .enumerate()
        .map(|(k, name)| json!({"id": k + 1, "name": name, "supercategory": "fastener"}));
    json!({
        "images": images.collect::<Vec<_>>(),
        "annotations": annotations.collect::<Vec<_>>(),
        "categories": categories.collect::<Vec<_>>(),
    })
}

/// A line a fastener: class, then centre and size of its box as shares of the picture, then the score of a find.
fn yolo(picture: &Picture) -> String {
    let (width, height) = (f64::from(picture.size_px.0), f64::from(picture.size_px.1));
    let mut text = String::new();
    for fastener in picture.fasteners.iter().filter(|f| !f.hidden) {
        let [left, top, right, bottom] = fastener.bounds(picture.size_px);
        let (u, v) = (0.5 * (left + right) / width, 0.5 * (top + bottom) / height);
        let (du, dv) = ((right - left) / width, (bottom - top) / height);
        text += &format!("{} {u:.6} {v:.6} {du:.6} {dv:.6}", class(fastener.drive));
        if let Some(score) = fastener.score {
            text += &format!(" {score:.4}");
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Picture {
        let fastener = |u, v, drive, score| Fastener {
            drive,
            center_px: [u, v],
            side_px: 20.0,
            score,
            hidden: false,
        };
        Picture {
            file: "a.jpg".into(),
            size_px: (200, 100),
            fasteners: vec![
                fastener(49.5, 29.5, Drive::Cross, None),
                fastener(194.5, 49.5, Drive::Torx, Some(0.75)), // half of it outside
            ],
        }
    }

    #[test]
    fn boxes_are_what_the_formats_say() {
        let value = coco(&[picture()]);
        assert_eq!(value["images"][0]["file_name"], "a.jpg");
        assert_eq!(value["annotations"][0]["bbox"], json!([40.0, 20.0, 20.0, 20.0]));
        assert_eq!(value["annotations"][1]["bbox"], json!([185.0, 40.0, 15.0, 20.0]));
        assert_eq!(value["annotations"][1]["score"], 0.75);
        let category = value["annotations"][1]["category_id"].as_u64().expect("a number") as usize;
        assert_eq!(value["categories"][category - 1]["name"], "torx");
        assert_eq!(
            yolo(&picture()),
            "0 0.250000 0.300000 0.100000 0.200000\n3 0.962500 0.500000 0.075000 0.200000 0.7500\n"
        );
    }

    #[test]
    fn a_yolo_folder_has_labels_and_names() {
        let folder = tempfile::tempdir().expect("folder");
        write(folder.path(), Format::Yolo, &[picture()]).expect("written");
        let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).expect(name);
        assert_eq!(read("labels/a.txt").lines().count(), 2);
        assert!(read("data.yaml").contains("\n  3: torx\n"), "{}", read("data.yaml"));
    }
}
