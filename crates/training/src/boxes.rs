//! Pictures with boxes drawn by people: COCO, YOLO and Pascal VOC.
//!
//! | format | boxes | pictures |
//! |---|---|---|
//! | COCO | `annotations.json` or `_annotations.coco.json` | in `images/`, or beside it |
//! | YOLO | `labels/*.txt`, names of the classes in `data.yaml`; without it class 1 is a cross recess and 0 a hexagon | in `images/` |
//! | Pascal VOC | `Annotations/*.xml` | in `JPEGImages/` |
//!
//! `manifest.csv` with the columns `file` and `scene` says which pictures show the same; without it each is its own scene.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

/// Why a folder of pictures with boxes cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum BoxesError {
    /// A file that cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file that cannot be understood.
    #[error("{path}: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong and what is expected.
        reason: String,
    },
    /// A folder without pictures with boxes.
    #[error(
        "no pictures with boxes in {path}; expected annotations.json (COCO), labels/ (YOLO) or Annotations/ (Pascal VOC), and pictures"
    )]
    Nothing {
        /// The folder.
        path: PathBuf,
    },
}

/// What a box is drawn around.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BoxKind {
    /// A fastener with a cross recess.
    Cross,
    /// Any other fastener.
    Other,
    /// There, but nobody is expected to find it (`iscrowd`, `difficult`).
    Hidden,
}

/// A box drawn by a person, px: 0 is the centre of the first pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DrawnBox {
    /// What is in it.
    pub kind: BoxKind,
    /// Left and upper edge.
    pub low: [f64; 2],
    /// Right and lower edge.
    pub high: [f64; 2],
}

/// A box's kind, its left and upper and its right and lower edge.
type Edges = (BoxKind, [f64; 2], [f64; 2]);

/// A picture with its boxes.
#[derive(Clone, Debug, PartialEq)]
pub struct BoxedPicture {
    /// Its file.
    pub path: PathBuf,
    /// Its name, as a report says it.
    pub name: String,
    /// What it shows: pictures of one scene show the same fasteners.
    pub scene: String,
    /// Boxes, in shares of the picture (YOLO) or in pixels, both from the outer edge of the first pixel.
    boxes: Vec<Edges>,
    shares: bool,
}

impl BoxedPicture {
    /// The boxes in a picture of that size.
    pub fn boxes(&self, (width, height): (u32, u32)) -> Vec<DrawnBox> {
        let size = if self.shares {
            [f64::from(width), f64::from(height)]
        } else {
            [1.0; 2]
        };
        let to_px = |edge: [f64; 2]| [0, 1].map(|k| edge[k] * size[k] - 0.5);
        self.boxes
            .iter()
            .map(|&(kind, low, high)| DrawnBox {
                kind,
                low: to_px(low),
                high: to_px(high),
            })
            .collect()
    }
}

/// The pictures of a folder, in whichever of the formats it is.
///
/// # Errors
/// An [`BoxesError`] that names the file that is missing or cannot be understood.
pub fn boxed_pictures(folder: &Path) -> Result<Vec<BoxedPicture>, BoxesError> {
    let coco = ["annotations.json", "_annotations.coco.json"].map(|name| folder.join(name));
    let mut pictures = if let Some(path) = coco.iter().find(|p| p.is_file()) {
        coco_pictures(folder, path)?
    } else if folder.join("labels").is_dir() {
        yolo_pictures(folder)?
    } else if folder.join("Annotations").is_dir() {
        voc_pictures(folder)?
    } else {
        return Err(BoxesError::Nothing { path: folder.into() });
    };
    let manifest = folder.join("manifest.csv");
    if manifest.is_file() {
        let rows = parse_manifest(&read(&manifest)?).map_err(|reason| malformed(&manifest, reason))?;
        let mut known: BTreeMap<String, BoxedPicture> = pictures.into_iter().map(|p| (p.name.clone(), p)).collect();
        pictures = rows
            .into_iter()
            .map(|(name, scene)| match known.remove(&name) {
                Some(picture) => Ok(BoxedPicture { scene, ..picture }),
                None => Err(malformed(&manifest, format!("there are no boxes for {name}"))),
            })
            .collect::<Result<_, _>>()?;
    }
    if pictures.is_empty() {
        return Err(BoxesError::Nothing { path: folder.into() });
    }
    Ok(pictures)
}

/// A box's kind by the name of its class, as people name them.
fn kind(name: &str) -> BoxKind {
    let name = name.to_lowercase();
    let cross = ["cross", "phillips", "philips", "pozi", "jis"];
    if cross.iter().any(|word| name.contains(word)) {
        BoxKind::Cross
    } else {
        BoxKind::Other
    }
}

fn malformed(path: &Path, reason: impl ToString) -> BoxesError {
    BoxesError::Format {
        path: path.into(),
        reason: reason.to_string(),
    }
}

fn read(path: &Path) -> Result<String, BoxesError> {
    std::fs::read_to_string(path).map_err(|source| BoxesError::Read {
        path: path.into(),
        source,
    })
}

/// Files of a folder with an extension, by name.
fn files(folder: &Path, extensions: &[&str]) -> Result<Vec<PathBuf>, BoxesError> {
    let entries = std::fs::read_dir(folder).and_then(|entries| entries.map(|e| Ok(e?.path())).collect());
    let mut files: Vec<PathBuf> = entries.map_err(|source| BoxesError::Read {
        path: folder.into(),
        source,
    })?;
    files.retain(|f| {
        let extension = f
            .extension()
            .and_then(|e| e.to_str())
            .unwrap_or_default()
            .to_lowercase();
        extensions.contains(&extension.as_str())
    });
    files.sort();
    Ok(files)
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn stem_of(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

#[derive(Deserialize)]
struct Coco {
    images: Vec<CocoImage>,
    annotations: Vec<CocoBox>,
    categories: Vec<CocoCategory>,
}

#[derive(Deserialize)]
struct CocoImage {
    id: u64,
    file_name: String,
}

#[derive(Deserialize)]
struct CocoBox {
    image_id: u64,
    category_id: u64,
    bbox: [f64; 4],
    #[serde(default)]
    iscrowd: u8,
}

#[derive(Deserialize)]
struct CocoCategory {
    id: u64,
    name: String,
}

fn coco_pictures(folder: &Path, path: &Path) -> Result<Vec<BoxedPicture>, BoxesError> {
    let coco: Coco = serde_json::from_str(&read(path)?).map_err(|e| malformed(path, e))?;
    let kinds: BTreeMap<u64, BoxKind> = coco.categories.iter().map(|c| (c.id, kind(&c.name))).collect();
    let mut boxes: BTreeMap<u64, Vec<_>> = coco.images.iter().map(|i| (i.id, Vec::new())).collect();
    for a in &coco.annotations {
        let known = kinds.get(&a.category_id).copied();
        let known = known.ok_or_else(|| {
            malformed(
                path,
                format!("a box has category {}, which is not listed", a.category_id),
            )
        })?;
        let of = boxes.get_mut(&a.image_id);
        let of = of.ok_or_else(|| malformed(path, format!("a box is on image {}, which is not listed", a.image_id)))?;
        let [x, y, w, h] = a.bbox;
        let kind = if a.iscrowd == 1 { BoxKind::Hidden } else { known };
        of.push((kind, [x, y], [x + w, y + h]));
    }
    let images = folder.join("images");
    Ok(coco
        .images
        .iter()
        .map(|image| {
            let inside = images.join(&image.file_name);
            BoxedPicture {
                path: if inside.is_file() {
                    inside
                } else {
                    folder.join(&image.file_name)
                },
                name: image.file_name.clone(),
                scene: stem_of(Path::new(&image.file_name)),
                boxes: boxes.remove(&image.id).unwrap_or_default(),
                shares: false,
            }
        })
        .collect())
}

/// Names of classes: a list, or a map by number.
#[derive(Deserialize)]
#[serde(untagged)]
enum YoloNames {
    List(Vec<String>),
    Map(BTreeMap<usize, String>),
}

#[derive(Deserialize)]
struct YoloData {
    names: YoloNames,
}

fn yolo_pictures(folder: &Path) -> Result<Vec<BoxedPicture>, BoxesError> {
    let data = folder.join("data.yaml");
    let kinds: BTreeMap<usize, BoxKind> = if data.is_file() {
        let data: YoloData = serde_saphyr::from_str(&read(&data)?).map_err(|e| malformed(&data, e))?;
        match data.names {
            YoloNames::List(names) => names.iter().map(|n| kind(n)).enumerate().collect(),
            YoloNames::Map(names) => names.into_iter().map(|(k, n)| (k, kind(&n))).collect(),
        }
    } else {
        BTreeMap::from([(0, BoxKind::Other), (1, BoxKind::Cross)])
    };
    files(&folder.join("images"), &["jpg", "jpeg", "png"])?
        .into_iter()
        .map(|path| {
            let label = folder.join("labels").join(format!("{}.txt", stem_of(&path)));
            // YOLO leaves out the file of a picture on which there is nothing
            let text = if label.is_file() { read(&label)? } else { String::new() };
            Ok(BoxedPicture {
                name: name_of(&path),
                scene: stem_of(&path),
                boxes: yolo_boxes(&text, &kinds).map_err(|reason| malformed(&label, reason))?,
                shares: true,
                path,
            })
        })
        .collect()
}

/// Lines of `class x y w h`, perhaps with a score, or `class x1 y1 x2 y2 x3 y3 ...` (a polygon), as shares of the picture's size.
fn yolo_boxes(text: &str, kinds: &BTreeMap<usize, BoxKind>) -> Result<Vec<Edges>, String> {
    let mut boxes = Vec::new();
    for (line, number) in text.lines().zip(1..) {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let [class, numbers @ ..] = fields.as_slice() else {
            continue;
        };
        let known = class.parse().ok().and_then(|k: usize| kinds.get(&k).copied());
        let known = known.ok_or_else(|| format!("line {number}: class {class} is none of {:?}", kinds.keys()))?;
        let finite = |n: &&str| n.parse().ok().filter(|v: &f64| v.is_finite());
        let values: Option<Vec<f64>> = numbers.iter().map(finite).collect();
        let values = values.ok_or_else(|| format!("line {number}: expected numbers after the class"))?;
        boxes.push(match values.as_slice() {
            [x, y, w, h] | [x, y, w, h, _] => (known, [x - 0.5 * w, y - 0.5 * h], [x + 0.5 * w, y + 0.5 * h]),
            corners if corners.len() >= 6 && corners.len() % 2 == 0 => {
                let each = |k: usize| corners.iter().skip(k).step_by(2).copied();
                (
                    known,
                    [0, 1].map(|k| each(k).fold(f64::MAX, f64::min)),
                    [0, 1].map(|k| each(k).fold(f64::MIN, f64::max)),
                )
            }
            _ => {
                let n = values.len();
                return Err(format!(
                    "line {number}: {n} numbers after the class; expected a box of 4 or a polygon"
                ));
            }
        });
    }
    Ok(boxes)
}

#[derive(Deserialize)]
struct Voc {
    filename: String,
    #[serde(rename = "object", default)]
    objects: Vec<VocObject>,
}

#[derive(Deserialize)]
struct VocObject {
    name: String,
    #[serde(default)]
    difficult: u8,
    bndbox: VocBox,
}

#[derive(Deserialize)]
struct VocBox {
    xmin: f64,
    ymin: f64,
    xmax: f64,
    ymax: f64,
}

fn voc_pictures(folder: &Path) -> Result<Vec<BoxedPicture>, BoxesError> {
    files(&folder.join("Annotations"), &["xml"])?
        .into_iter()
        .map(|path| {
            let voc: Voc = quick_xml::de::from_str(&read(&path)?).map_err(|e| malformed(&path, e))?;
            let object = |o: &VocObject| {
                let kind = if o.difficult == 1 {
                    BoxKind::Hidden
                } else {
                    kind(&o.name)
                };
                // its first pixel is 1, and the last one belongs to the box
                (
                    kind,
                    [o.bndbox.xmin - 1.0, o.bndbox.ymin - 1.0],
                    [o.bndbox.xmax, o.bndbox.ymax],
                )
            };
            Ok(BoxedPicture {
                path: folder.join("JPEGImages").join(&voc.filename),
                scene: stem_of(Path::new(&voc.filename)),
                boxes: voc.objects.iter().map(object).collect(),
                name: voc.filename,
                shares: false,
            })
        })
        .collect()
}

/// Files and their scenes, from the columns `file` and `scene` of a manifest.
fn parse_manifest(text: &str) -> Result<Vec<(String, String)>, String> {
    let mut lines = text.lines().zip(1..);
    let fields = |line: &str| -> Vec<String> { line.split(',').map(|f| f.trim().to_owned()).collect() };
    let header = lines.next().map(|(line, _)| fields(line)).unwrap_or_default();
    let column = |name: &str| {
        let place = header.iter().position(|h| h == name);
        place.ok_or_else(|| format!("no column {name}; expected a CSV file with the columns file and scene"))
    };
    let (file, scene) = (column("file")?, column("scene")?);
    let mut rows = Vec::new();
    for (line, number) in lines.filter(|(l, _)| !l.trim().is_empty()) {
        let row = fields(line);
        if row.len() != header.len() {
            return Err(format!(
                "line {number} has {} fields, its header {}; names must not hold commas",
                row.len(),
                header.len()
            ));
        }
        rows.push((row[file].clone(), row[scene].clone()));
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn manifests() {
        let rows = parse_manifest("scene,file,n\ns1,a.jpg,3\n\ns2,b.jpg,4\n").expect("two rows");
        assert_eq!(rows[1], ("b.jpg".into(), "s2".into()));
        assert!(parse_manifest("file,n\n").is_err_and(|e| e.contains("scene")));
        assert!(parse_manifest("file,scene\na,b,c\n").is_err_and(|e| e.contains("line 2")));
    }

    /// The same two boxes on a picture of 200 x 100 px.
    fn check(pictures: &[BoxedPicture], name: &str) {
        let [picture] = pictures else {
            panic!("{name}: {pictures:?}")
        };
        assert_eq!(
            (picture.name.as_str(), picture.scene.as_str()),
            ("a.jpg", "a"),
            "{name}"
        );
        assert!(picture.path.is_file(), "{name}: {}", picture.path.display());
        let boxes = picture.boxes((200, 100));
        let expected = [
            (BoxKind::Cross, [39.5, 19.5], [59.5, 39.5]),
            (BoxKind::Other, [99.5, 49.5], [119.5, 69.5]),
        ];
        for (found, (kind, low, high)) in boxes.iter().zip(expected) {
            assert_eq!(found.kind, kind, "{name}");
            for k in 0..2 {
                assert!(
                    (found.low[k] - low[k]).abs() < 1e-9 && (found.high[k] - high[k]).abs() < 1e-9,
                    "{name}: {found:?}"
                );
            }
        }
        assert_eq!(boxes.len(), 2, "{name}");
    }

    #[test]
    fn the_three_formats_say_the_same() {
        let folder = tempfile::tempdir().expect("folder");
        let write = |name: &str, text: &str| {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().expect("folder")).expect("folder");
            fs::write(path, text).expect(name);
        };
        write("coco/images/a.jpg", "");
        write(
            "coco/annotations.json",
            r#"{"images":[{"id":7,"file_name":"a.jpg","width":200,"height":100}],
                "annotations":[{"image_id":7,"category_id":3,"bbox":[40,20,20,20]},{"image_id":7,"category_id":1,"bbox":[100,50,20,20]}],
                "categories":[{"id":1,"name":"Torx"},{"id":3,"name":"Phillips screw"}]}"#,
        );
        write("yolo/images/a.jpg", "");
        write(
            "yolo/labels/a.txt",
            "1 0.25 0.3 0.1 0.2\n\n0 0.5 0.5 0.6 0.5 0.6 0.7 0.5 0.7\n",
        );
        write("voc/JPEGImages/a.jpg", "");
        write(
            "voc/Annotations/a.xml",
            "<annotation><folder>x</folder><filename>a.jpg</filename><size><width>200</width></size>\
             <object><name>cross</name><bndbox><xmin>41</xmin><ymin>21</ymin><xmax>60</xmax><ymax>40</ymax></bndbox></object>\
             <object><name>hex</name><difficult>0</difficult><bndbox><xmin>101</xmin><ymin>51</ymin><xmax>120</xmax><ymax>70</ymax></bndbox></object>\
             </annotation>",
        );
        for name in ["coco", "yolo", "voc"] {
            check(&boxed_pictures(&folder.path().join(name)).expect(name), name);
        }
        // names by number, as this project writes them
        write("yolo/data.yaml", "path: .\nnames:\n  0: torx\n  1: cross\n");
        check(&boxed_pictures(&folder.path().join("yolo")).expect("named"), "named");
        write("yolo/data.yaml", "names: [torx]\n");
        let error = boxed_pictures(&folder.path().join("yolo"))
            .expect_err("class 1 has no name")
            .to_string();
        assert!(error.contains("a.txt") && error.contains("class 1"), "{error}");
        write("coco/manifest.csv", "file,scene\nb.jpg,x\n");
        let error = boxed_pictures(&folder.path().join("coco"))
            .expect_err("no such picture")
            .to_string();
        assert!(error.contains("manifest.csv") && error.contains("b.jpg"), "{error}");
        let error = boxed_pictures(folder.path()).expect_err("nothing there").to_string();
        assert!(error.contains("COCO") && error.contains("YOLO"), "{error}");
    }
}
