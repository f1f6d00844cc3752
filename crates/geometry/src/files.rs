//! Files: colour (PNG, JPEG, TIFF), depth (16-bit PNG, float TIFF), ROS `camera_info`; written aside, then renamed.

use crate::{CameraModel, DepthMap, RgbdFrame};
use image::{DynamicImage, ImageDecoder, ImageReader, RgbImage, codecs::jpeg::JpegEncoder};
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::{
    fs,
    io::{BufReader, Write},
    path::{Path, PathBuf},
};

/// What went wrong with a file, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The file could not be opened or read.
    #[error("cannot read {path}: {source}; check the path and its permissions")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file could not be written.
    #[error("cannot write {path}: {source}; check that the folder exists, is writable and has space")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file has no bytes.
    #[error("{path} is empty (0 bytes); copy or record it again")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// Not a picture that can be decoded.
    #[error("{path} is not a readable picture ({reason}); expected a whole PNG, JPEG or TIFF file")]
    Picture {
        /// The file.
        path: PathBuf,
        /// The decoder's reason.
        reason: String,
    },
    /// Depth of a wrong kind.
    #[error("{path} is not a depth picture ({reason}); expected a 16-bit grey PNG or a 32-bit float grey TIFF")]
    Depth {
        /// The file.
        path: PathBuf,
        /// What was found.
        reason: String,
    },
    /// Depth and colour of sizes that do not belong together.
    #[error(
        "depth {path} is {depth_width} x {depth_height} but the colour picture is {width} x {height}; depth must be registered to it at the same or an integer fraction of its resolution"
    )]
    DepthSize {
        /// The depth file.
        path: PathBuf,
        /// Columns of the depth picture.
        depth_width: u32,
        /// Rows of the depth picture.
        depth_height: u32,
        /// Columns of the colour picture.
        width: u32,
        /// Rows of the colour picture.
        height: u32,
    },
    /// A camera file that lacks something or has it wrong.
    #[error("camera file {path}: {reason}; expected a ROS camera_info YAML with distortion_model plumb_bob")]
    CameraInfo {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A picture could not be encoded.
    #[error("cannot encode {path}: {reason}")]
    Encode {
        /// The file.
        path: PathBuf,
        /// The encoder's reason.
        reason: String,
    },
}

fn bytes(path: &Path) -> Result<Vec<u8>, FileError> {
    let bytes = fs::read(path).map_err(|source| FileError::Read {
        path: path.into(),
        source,
    })?;
    if bytes.is_empty() {
        return Err(FileError::Empty { path: path.into() });
    }
    Ok(bytes)
}

fn decode(path: &Path) -> Result<DynamicImage, FileError> {
    let bytes = bytes(path)?;
    let bad = |reason: String| FileError::Picture {
        path: path.into(),
        reason,
    };
    let mut decoder = ImageReader::new(BufReader::new(std::io::Cursor::new(bytes)))
        .with_guessed_format()
        .map_err(|e| bad(e.to_string()))?
        .into_decoder()
        .map_err(|e| bad(e.to_string()))?;
    // a photograph turned by its EXIF tag is turned upright: pixel coordinates are those of the picture a viewer shows
    let orientation = decoder
        .orientation()
        .unwrap_or(image::metadata::Orientation::NoTransforms);
    let mut picture = DynamicImage::from_decoder(decoder).map_err(|e| bad(e.to_string()))?;
    picture.apply_orientation(orientation);
    Ok(picture)
}

/// Reads a colour picture (PNG, JPEG, TIFF; grey, alpha and 16 bit are converted) as 8-bit sRGB, upright by its EXIF tag.
///
/// # Errors
/// [`FileError::Read`], [`FileError::Empty`] or [`FileError::Picture`], each with the file's name.
pub fn read_color(path: &Path) -> Result<RgbImage, FileError> {
    Ok(decode(path)?.into_rgb8())
}

/// Reads registered depth: a 16-bit PNG in units of `scale_mm`, or a float TIFF in mm times `scale_mm`; 0 and NaN are holes.
///
/// # Errors
/// [`FileError::Depth`] for another kind of picture, [`FileError::DepthSize`] if it does not belong to `color_size` (columns, rows).
pub fn read_depth(path: &Path, scale_mm: f64, color_size: (u32, u32)) -> Result<DepthMap, FileError> {
    let (width, height, raw) = if is_tiff(path)? {
        decode_float_tiff(path)?
    } else {
        decode_grey16(path)?
    };
    let scale = scale_mm as f32;
    let depth_mm = raw
        .into_iter()
        .map(|z| if z.is_finite() && z > 0.0 { z * scale } else { 0.0 })
        .collect();
    let step = DepthMap::step_between(color_size, (width, height)).ok_or_else(|| FileError::DepthSize {
        path: path.into(),
        depth_width: width,
        depth_height: height,
        width: color_size.0,
        height: color_size.1,
    })?;
    Ok(DepthMap {
        width,
        height,
        step,
        depth_mm,
    })
}

fn is_tiff(path: &Path) -> Result<bool, FileError> {
    let bytes = bytes(path)?;
    Ok(bytes.starts_with(b"II*\0") || bytes.starts_with(b"MM\0*"))
}

fn decode_grey16(path: &Path) -> Result<(u32, u32, Vec<f32>), FileError> {
    match decode(path)? {
        DynamicImage::ImageLuma16(p) => Ok((
            p.width(),
            p.height(),
            p.as_raw().iter().map(|&z| f32::from(z)).collect(),
        )),
        other => Err(FileError::Depth {
            path: path.into(),
            reason: format!("its pixels are {:?}", other.color()),
        }),
    }
}

/// Grey float TIFF: the `image` crate reads colour only, so its own decoder is asked.
fn decode_float_tiff(path: &Path) -> Result<(u32, u32, Vec<f32>), FileError> {
    let bad = |reason: String| FileError::Depth {
        path: path.into(),
        reason,
    };
    let mut decoder =
        tiff::decoder::Decoder::new(std::io::Cursor::new(bytes(path)?)).map_err(|e| bad(e.to_string()))?;
    let (width, height) = decoder.dimensions().map_err(|e| bad(e.to_string()))?;
    let pixels = width as usize * height as usize;
    let raw: Vec<f32> = match decoder.read_image().map_err(|e| bad(e.to_string()))? {
        tiff::decoder::DecodingResult::F32(z) => z,
        tiff::decoder::DecodingResult::F64(z) => z.into_iter().map(|z| z as f32).collect(),
        tiff::decoder::DecodingResult::U16(z) => z.into_iter().map(f32::from).collect(),
        _ => return Err(bad("its pixels are neither float nor 16 bit".into())),
    };
    if raw.len() != pixels {
        return Err(bad(format!("it has {} channels, not one", raw.len() / pixels.max(1))));
    }
    Ok((width, height, raw))
}

/// Reads a whole shot: colour, and depth and camera where given.
///
/// # Errors
/// Those of [`read_color`], [`read_depth`] and [`read_camera_info`]; [`FileError::CameraInfo`] if the camera is of another picture size.
pub fn read_rgbd(color: &Path, depth: Option<(&Path, f64)>, camera: Option<&Path>) -> Result<RgbdFrame, FileError> {
    let picture = read_color(color)?;
    let depth = depth
        .map(|(path, scale_mm)| read_depth(path, scale_mm, picture.dimensions()))
        .transpose()?;
    let camera = camera
        .map(|path| {
            let model = read_camera_info(path)?;
            if (model.width_px, model.height_px) != picture.dimensions() {
                return Err(FileError::CameraInfo {
                    path: path.into(),
                    reason: format!(
                        "it is for pictures of {} x {}, but {} is {} x {}",
                        model.width_px,
                        model.height_px,
                        color.display(),
                        picture.width(),
                        picture.height()
                    ),
                });
            }
            Ok(model)
        })
        .transpose()?;
    Ok(RgbdFrame {
        color: picture,
        depth,
        camera,
        t_s: 0.0,
    })
}

#[derive(Deserialize)]
struct CameraInfoMatrix {
    data: Vec<f64>,
}

#[derive(Deserialize)]
struct CameraInfo {
    image_width: u32,
    image_height: u32,
    camera_matrix: CameraInfoMatrix,
    distortion_model: String,
    distortion_coefficients: CameraInfoMatrix,
}

/// Reads a ROS `camera_info` YAML (`plumb_bob`).
///
/// # Errors
/// [`FileError::CameraInfo`] naming the key that is missing or wrong.
pub fn read_camera_info(path: &Path) -> Result<CameraModel, FileError> {
    let bad = |reason: String| FileError::CameraInfo {
        path: path.into(),
        reason,
    };
    let text = String::from_utf8(bytes(path)?).map_err(|_| bad("it is not text".into()))?;
    let info: CameraInfo = serde_saphyr::from_str(&text).map_err(|e| {
        // the first line says what and where; the rest is a picture of the file
        bad(e.to_string().lines().next().unwrap_or_default().to_owned())
    })?;
    if info.distortion_model != "plumb_bob" {
        return Err(bad(format!("distortion_model is {}", info.distortion_model)));
    }
    let k = &info.camera_matrix.data;
    let d = &info.distortion_coefficients.data;
    if k.len() != 9 {
        return Err(bad(format!("camera_matrix has {} numbers, not 9", k.len())));
    }
    if d.len() > 5 {
        return Err(bad(format!("distortion_coefficients has {} numbers, not 5", d.len())));
    }
    if k.iter().chain(d).any(|v| !v.is_finite()) || k[0] <= 0.0 || k[4] <= 0.0 {
        return Err(bad("camera_matrix holds no valid focal length".into()));
    }
    let mut distortion = [0.0; 5];
    distortion[..d.len()].copy_from_slice(d);
    Ok(CameraModel {
        width_px: info.image_width,
        height_px: info.image_height,
        fx_px: k[0],
        fy_px: k[4],
        cx_px: k[2],
        cy_px: k[5],
        distortion,
    })
}

/// Writes a ROS `camera_info` YAML that [`read_camera_info`] reads back to the last digit.
///
/// # Errors
/// [`FileError::Write`].
pub fn write_camera_info(path: &Path, name: &str, c: &CameraModel) -> Result<(), FileError> {
    let [k1, k2, p1, p2, k3] = c.distortion;
    let (fx, fy, cx, cy) = (c.fx_px, c.fy_px, c.cx_px, c.cy_px);
    let text = format!(
        "image_width: {}\nimage_height: {}\ncamera_name: {name}\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [{fx:?}, 0.0, {cx:?}, 0.0, {fy:?}, {cy:?}, 0.0, 0.0, 1.0]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{k1:?}, {k2:?}, {p1:?}, {p2:?}, {k3:?}]\nrectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\nprojection_matrix:\n  rows: 3\n  cols: 4\n  data: [{fx:?}, 0.0, {cx:?}, 0.0, 0.0, {fy:?}, {cy:?}, 0.0, 0.0, 0.0, 1.0, 0.0]\n",
        c.width_px, c.height_px
    );
    write_aside(path, text.as_bytes())
}

/// The name of bytes by what they are: their SHA-256 in 64 hexadecimal digits.
pub fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Writes bytes beside the target, then renames: a reader sees the old file or the whole new one, never a part.
///
/// # Errors
/// [`FileError::Write`].
pub fn write_aside(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let failed = |source| FileError::Write {
        path: path.into(),
        source,
    };
    let folder = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let mut aside = tempfile::NamedTempFile::new_in(folder).map_err(failed)?;
    aside.write_all(bytes).map_err(failed)?;
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        aside
            .as_file()
            .set_permissions(fs::Permissions::from_mode(0o644))
            .map_err(failed)?;
    }
    aside.persist(path).map_err(|e| failed(e.error))?;
    Ok(())
}

fn encode(path: &Path, result: image::ImageResult<()>, bytes: Vec<u8>) -> Result<(), FileError> {
    result.map_err(|e| FileError::Encode {
        path: path.into(),
        reason: e.to_string(),
    })?;
    write_aside(path, &bytes)
}

/// Writes a colour picture as PNG.
///
/// # Errors
/// [`FileError::Write`] or [`FileError::Encode`].
pub fn write_png(path: &Path, picture: &RgbImage) -> Result<(), FileError> {
    let mut out = std::io::Cursor::new(Vec::new());
    let result = picture.write_to(&mut out, image::ImageFormat::Png);
    encode(path, result, out.into_inner())
}

/// Writes a colour picture as JPEG of a quality from 1 to 100.
///
/// # Errors
/// [`FileError::Write`] or [`FileError::Encode`].
pub fn write_jpeg(path: &Path, picture: &RgbImage, quality: u8) -> Result<(), FileError> {
    let mut out = Vec::new();
    let result = JpegEncoder::new_with_quality(&mut out, quality).encode_image(picture);
    encode(path, result, out)
}

/// Writes depth as a 16-bit PNG in units of `scale_mm` (0.1: up to 6.5 m).
///
/// # Errors
/// [`FileError::Write`] or [`FileError::Encode`].
pub fn write_depth_png(path: &Path, depth: &DepthMap, scale_mm: f64) -> Result<(), FileError> {
    let raw: Vec<u16> = depth
        .depth_mm
        .iter()
        .map(|&z| {
            if z.is_finite() && z > 0.0 {
                (f64::from(z) / scale_mm).round().min(65535.0) as u16
            } else {
                0
            }
        })
        .collect();
    let picture =
        image::ImageBuffer::<image::Luma<u16>, _>::from_raw(depth.width, depth.height, raw).ok_or_else(|| {
            FileError::Encode {
                path: path.into(),
                reason: "the depth map has a wrong size".into(),
            }
        })?;
    let mut out = std::io::Cursor::new(Vec::new());
    let result = picture.write_to(&mut out, image::ImageFormat::Png);
    encode(path, result, out.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder() -> tempfile::TempDir {
        tempfile::tempdir().expect("a temporary folder")
    }

    #[test]
    fn depth_png_round_trip_and_size_check() {
        let dir = folder();
        let path = dir.path().join("d.png");
        let depth = DepthMap {
            width: 20,
            height: 15,
            step: 2,
            depth_mm: (0..300).map(|k| k as f32 * 5.3).collect(),
        };
        write_depth_png(&path, &depth, 0.1).expect("written");
        let back = read_depth(&path, 0.1, (40, 30)).expect("read");
        assert_eq!(back.step, 2);
        assert!(
            back.depth_mm
                .iter()
                .zip(&depth.depth_mm)
                .all(|(a, b)| (a - b).abs() <= 0.0501)
        );
        let error = read_depth(&path, 0.1, (50, 30)).expect_err("wrong size").to_string();
        assert!(
            error.contains("d.png") && error.contains("20 x 15") && error.contains("50 x 30"),
            "{error}"
        );
    }

    #[test]
    fn float_tiff_depth() {
        let dir = folder();
        let path = dir.path().join("d.tiff");
        let data: Vec<f32> = (0..12)
            .map(|k| if k == 3 { f32::NAN } else { 1400.0 + k as f32 * 0.25 })
            .collect();
        let file = fs::File::create(&path).expect("created");
        let mut tiff = tiff::encoder::TiffEncoder::new(file).expect("encoder");
        tiff.write_image::<tiff::encoder::colortype::Gray32Float>(4, 3, &data)
            .expect("written");
        let back = read_depth(&path, 1.0, (4, 3)).expect("read");
        assert_eq!(back.at(3, 0), None);
        assert_eq!(back.at(2, 1), Some(1401.5));
    }

    #[test]
    fn camera_info_round_trip_and_missing_key() {
        let dir = folder();
        let path = dir.path().join("camera.yaml");
        let model = CameraModel {
            distortion: [-0.08480143144056217, 0.07, -1.0e-4, 2e-4, 0.0],
            ..CameraModel::pinhole(4104, 3006, 4627.942377108884, 4626.1)
        };
        write_camera_info(&path, "cell", &model).expect("written");
        assert_eq!(read_camera_info(&path).expect("read"), model);
        let text = fs::read_to_string(&path)
            .expect("text")
            .replace("camera_matrix", "kamera_matrix");
        fs::write(&path, text).expect("written");
        let error = read_camera_info(&path).expect_err("no matrix").to_string();
        assert!(
            error.contains("camera_matrix") && error.contains("camera.yaml"),
            "{error}"
        );
    }

    #[test]
    fn bad_pictures_are_named() {
        let dir = folder();
        let text = dir.path().join("note.jpg");
        fs::write(&text, "not a picture").expect("written");
        assert!(matches!(read_color(&text), Err(FileError::Picture { .. })));
        let empty = dir.path().join("empty.png");
        fs::write(&empty, "").expect("written");
        assert!(matches!(read_color(&empty), Err(FileError::Empty { .. })));
        let whole = dir.path().join("whole.png");
        write_png(
            &whole,
            &RgbImage::from_fn(64, 64, |x, y| image::Rgb([x as u8, y as u8, (x * y) as u8])),
        )
        .expect("written");
        let bytes = fs::read(&whole).expect("bytes");
        let cut = dir.path().join("cut.png");
        fs::write(&cut, &bytes[..bytes.len() / 2]).expect("written");
        assert!(matches!(read_color(&cut), Err(FileError::Picture { .. })));
    }

    #[test]
    fn bytes_have_the_name_that_sha256sum_gives_them() {
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"; // FIPS 180-2, appendix B.1
        assert_eq!(sha256_hex(b"abc"), abc);
    }

    #[test]
    fn a_failed_write_leaves_nothing() {
        let dir = folder();
        let path = dir.path().join("missing").join("x.json");
        assert!(matches!(write_aside(&path, b"{}"), Err(FileError::Write { .. })));
        assert_eq!(fs::read_dir(dir.path()).expect("folder").count(), 0);
    }
}
