//! The command line as its users meet it: contracts of files and exit codes, and what bad input gets for an answer.

use serde_json::Value;
use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
};

fn unscrew(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_unscrew"))
        .current_dir(folder)
        .args(args)
        .output()
        .expect("the program starts")
}

/// Runs it, expects exit code 1, no panic, and a message that holds every one of `words`.
fn refused(folder: &Path, args: &[&str], words: &[&str]) {
    let output = unscrew(folder, args);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{args:?}: {text}");
    assert!(!text.contains("panicked"), "{args:?}: {text}");
    let reason = "(os error 2)";
    assert!(text.matches(reason).count() <= 1, "the reason is said twice: {text}");
    for word in words {
        assert!(text.contains(word), "{args:?}: '{word}' is not in: {text}");
    }
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

fn picture(path: PathBuf, width: u32, height: u32) {
    let pixels = image::RgbImage::from_fn(width, height, |x, y| {
        image::Rgb([120 + (x % 7) as u8, 118, 110 + (y % 5) as u8])
    });
    pixels.save(path).expect("written");
}

const CAMERA: &str = "image_width: 320\nimage_height: 240\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [400.0, 0.0, 160.0, 0.0, 400.0, 120.0, 0.0, 0.0, 1.0]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.0, 0.0, 0.0, 0.0, 0.0]\n";

#[test]
fn bad_pictures_are_refused_by_name() {
    let dir = folder();
    let at = dir.path();
    fs::write(at.join("note.jpg"), "this is text").expect("written");
    fs::write(at.join("empty.png"), "").expect("written");
    picture(at.join("whole.png"), 64, 48);
    let bytes = fs::read(at.join("whole.png")).expect("read");
    fs::write(at.join("cut.png"), &bytes[..bytes.len() / 2]).expect("written");
    refused(at, &["detect", "note.jpg"], &["note.jpg", "not a readable picture"]);
    refused(at, &["detect", "empty.png"], &["empty.png", "0 bytes"]);
    refused(at, &["detect", "cut.png"], &["cut.png"]);
    refused(at, &["detect", "missing.png"], &["missing.png"]);
    // one bad picture does not cost the good one
    let output = unscrew(at, &["detect", "note.jpg", "whole.png", "--json"]);
    assert_eq!(output.status.code(), Some(1));
    assert_eq!(String::from_utf8_lossy(&output.stdout).lines().count(), 1);
}

#[test]
fn a_picture_that_cannot_be_trusted_is_said() {
    let dir = folder();
    let white = image::RgbImage::from_pixel(200, 150, image::Rgb([255; 3]));
    white.save(dir.path().join("white.png")).expect("a picture");
    let output = unscrew(dir.path(), &["detect", "white.png", "--json"]);
    assert_eq!(output.status.code(), Some(3));
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("white.png: too bright to be trusted"), "{said}");
    assert!(String::from_utf8_lossy(&output.stdout).contains(r#""doubts":[{"why":"over_exposed","share":1.0}]"#));
}

#[test]
fn bad_companions_are_refused_by_name() {
    let dir = folder();
    let at = dir.path();
    picture(at.join("a.png"), 320, 240);
    image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(100, 77, image::Luma([15000u16]))
        .save(at.join("depth.png"))
        .expect("written");
    refused(
        at,
        &["detect", "a.png", "--depth", "depth.png"],
        &["depth.png", "100 x 77", "320 x 240"],
    );
    fs::write(at.join("camera.yaml"), CAMERA.replace("camera_matrix", "kamera_matrix")).expect("written");
    refused(
        at,
        &["detect", "a.png", "--camera", "camera.yaml"],
        &["camera.yaml", "camera_matrix"],
    );
    fs::write(at.join("other.unscrew"), b"UNSCREW9\x02\0\0\0{}").expect("written");
    refused(
        at,
        &["detect", "a.png", "--model", "other.unscrew"],
        &["other.unscrew", "format '9'"],
    );
    fs::write(at.join("map.json"), r#"{"format": "unscrew-map", "version": 99}"#).expect("written");
    let all = [
        "detect",
        "a.png",
        "--depth",
        "depth.png",
        "--camera",
        "good.yaml",
        "--map",
        "map.json",
    ];
    fs::write(at.join("good.yaml"), CAMERA).expect("written");
    refused(at, &all, &["map.json", "99"]);
}

#[test]
fn an_output_folder_that_cannot_be_is_said_before_any_work() {
    let dir = folder();
    let at = dir.path();
    fs::write(at.join("file"), "in the way").expect("written");
    picture(at.join("a.png"), 64, 48);
    refused(at, &["run", "--out", "file/out"], &["file/out", "--out"]);
    refused(at, &["detect", "a.png", "--overlay", "file/marked"], &["file/marked"]);
    refused(at, &["synth", "--out", "file/faces"], &["file/faces"]);
}

#[test]
fn wrong_usage_is_exit_code_2() {
    let dir = folder();
    for args in [
        &["detect"][..],
        &["detect", "a.png", "--head-px", "80..15"],
        &["frobnicate"],
    ] {
        assert_eq!(unscrew(dir.path(), args).status.code(), Some(2), "{args:?}");
    }
}

#[test]
fn a_plan_keeps_the_contract() {
    let folder = folder();
    let told = unscrew(folder.path(), &["plan", "--json", "--gantt", "plan.html"]);
    assert_eq!(told.status.code(), Some(0));
    let plan: serde_json::Value = serde_json::from_slice(&told.stdout).expect("JSON");
    let number = |key: &str| plan[key].as_f64().expect(key);
    assert!(number("bound_s") <= number("makespan_s") && number("gap") < 0.1);
    assert!(plan["steps"].as_array().is_some_and(|steps| steps.len() == 20));
    let page = std::fs::read_to_string(folder.path().join("plan.html")).expect("the page");
    assert!(page.contains("<svg") && page.contains("bound"));
    let ended = unscrew(folder.path(), &["plan", "--gap-max", "0"]).status.code();
    assert_eq!(ended, Some(3));
    std::fs::write(
        folder.path().join("odd.toml"),
        "product = \"x\"\nloaded = \"front\"\nscrew = 3\n",
    )
    .expect("written");
    refused(folder.path(), &["plan", "odd.toml"], &["odd.toml", "screw"]);
}

#[test]
fn a_tiny_picture_is_a_picture() {
    let dir = folder();
    picture(dir.path().join("dot.png"), 1, 1);
    let output = unscrew(dir.path(), &["detect", "dot.png", "--json"]);
    assert_eq!(
        output.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let line: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(line["width_px"], 1);
    assert_eq!(line["screws"], Value::Array(vec![]));
}

#[test]
fn fit_and_apply_keep_the_contract() {
    let dir = folder();
    let at = dir.path();
    // a camera that looks along +x of the base: camera x = -y, y = -z, z = x + 430; columns in another order than usual
    let mut pairs =
        String::from("valid,id,cmd_z_mm,cmd_y_mm,cmd_x_mm,t_s,u_px,v_px,depth_mm,cam_x_mm,cam_y_mm,cam_z_mm,i,j,k\n");
    let mut id = 0;
    for i in 0..4 {
        for j in 0..5 {
            for k in 0..5 {
                let (x, y, z) = (
                    950.0 + 130.0 * f64::from(i),
                    -450.0 + 225.0 * f64::from(j),
                    150.0 + 187.0 * f64::from(k),
                );
                let (cx, cy, cz) = (-y, 540.0 - z, x + 430.0);
                pairs.push_str(&format!("1,{id},{z},{y},{x},{id},,,{cz},{cx},{cy},{cz},{i},{j},{k}\n"));
                id += 1;
            }
        }
    }
    fs::write(at.join("pairs.csv"), &pairs).expect("written");
    let fit = unscrew(at, &["calibrate", "fit", "pairs.csv", "--out", "map.json"]);
    assert_eq!(fit.status.code(), Some(0), "{}", String::from_utf8_lossy(&fit.stderr));
    fs::write(
        at.join("queries.csv"),
        "id,u_px,v_px,depth_mm,cam_x_mm,cam_y_mm,cam_z_mm,valid\n7,,,1500,20.0,-60.0,1500.0,1\n8,,,,,,,0\n9,,,9000,20.0,-60.0,9000.0,1\n",
    )
    .expect("written");
    let apply = unscrew(at, &["calibrate", "apply", "--map", "map.json", "queries.csv"]);
    let text = String::from_utf8_lossy(&apply.stdout).into_owned();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(
        lines[0], "id,base_x_mm,base_y_mm,base_z_mm,sigma_lateral_mm,sigma_depth_mm,hull",
        "{text}"
    );
    let fields: Vec<&str> = lines[1].split(',').collect();
    for (field, truth) in fields[1..4].iter().zip([1070.0, -20.0, 600.0]) {
        assert!((field.parse::<f64>().expect("a number") - truth).abs() < 0.01, "{text}");
    }
    assert_eq!((fields[0], fields[6]), ("7", "inside"));
    assert!(lines[2].starts_with("8,,") && lines[3].ends_with("outside"), "{text}");
    fs::write(at.join("mixed.csv"), pairs.lines().next().unwrap_or_default()).expect("written");
    refused(
        at,
        &["calibrate", "fit", "mixed.csv", "--out", "no.json"],
        &["mixed.csv"],
    );
    assert!(!at.join("no.json").exists());
}

#[test]
fn networks_go_to_onnx_and_come_back() {
    let dir = folder();
    let at = dir.path();
    picture(at.join("a.png"), 200, 150);
    let exported = unscrew(at, &["model", "export", "--out", "onnx"]);
    assert!(exported.status.success(), "{exported:?}");
    let import = [
        "model",
        "import",
        "--coarse",
        "onnx/coarse.onnx",
        "--fine",
        "onnx/fine0.onnx",
        "--out",
        "m.unscrew",
    ];
    assert!(unscrew(at, &import).status.success());
    let found = unscrew(at, &["detect", "a.png", "--model", "m.unscrew", "--json"]);
    assert!(found.status.success(), "{found:?}");
    // stage 1 where stage 2 belongs
    let swapped = ["model", "import", "--fine", "onnx/coarse.onnx", "--out", "x.unscrew"];
    refused(at, &swapped, &["fine0"]);
    assert!(!at.join("x.unscrew").exists());
    refused(
        at,
        &["model", "import", "--fine", "a.png", "--out", "x.unscrew"],
        &["a.png", "ONNX"],
    );
}

#[test]
fn a_reader_that_has_seen_enough_ends_a_command_quietly() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_unscrew"))
        .args(["calibrate", "plan", "--spacing-mm", "20"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("it ends");
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(text.is_empty(), "{text}");
}

/// One whole unit, calibrated on a wide lattice: nothing the robot was sent to lies outside the calibrated volume, the page and the
/// summary are there, a second run into the same folder is refused, and the journal's statistics are those of the summary.
#[test]
fn a_unit_from_end_to_end() {
    let dir = folder();
    let at = dir.path();
    let output = unscrew(
        at,
        &[
            "run", "--units", "1", "--seed", "7200000", "--out", "out", "--points", "100", "--json",
        ],
    );
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{text}");
    let summary: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    // a unit of little wear: its 19 screws and its covers come off
    assert_eq!(
        (&summary["statistics"]["units"], &summary["statistics"]["ok"]),
        (&Value::from(1), &Value::from(1)),
        "{text}"
    );
    let removed = &summary["statistics"]["screws_removed"];
    assert!(removed["hits"].as_u64() >= Some(15), "{removed}");
    let written: Value =
        serde_json::from_slice(&fs::read(at.join("out/summary.json")).expect("summary")).expect("JSON");
    assert_eq!(written, summary);
    let page = fs::read_to_string(at.join("out/report.html")).expect("report");
    assert!(page.contains("78.3 %") && page.contains("report/unit001-00-"));
    let stats = unscrew(at, &["stats", "out", "--json"]);
    let mut stats: Value = serde_json::from_slice(&stats.stdout).expect("JSON");
    let counted = stats.as_object_mut().expect("an object");
    let mut count = |name: &str| counted.remove(name).and_then(|n| n.as_u64());
    assert!(count("actions_total") >= removed["hits"].as_u64());
    assert_eq!((count("actions_repeated"), count("actions_lost")), (Some(0), Some(0)));
    let unspoilt = stats.as_object_mut().and_then(|s| s.remove("ok_unspoilt"));
    assert!(unspoilt.is_some_and(|rate| rate["of"].as_u64() <= Some(1)));
    stats.as_object_mut().and_then(|s| s.remove("cycle_unspoilt_mean_s"));
    let predictions = stats.as_object_mut().and_then(|s| s.remove("predictions"));
    let predicted = predictions.as_ref().and_then(|p| p[0]["predicted"].as_f64());
    assert!(predicted.is_some_and(|p| (0.0..1.0).contains(&p)), "{predictions:?}");
    let shifts = stats.as_object_mut().and_then(|s| s.remove("shifts"));
    assert_eq!(shifts.map(|s| s[0]["units"].clone()), Some(1.into()));
    assert_eq!(stats, summary["statistics"]);
    let told = unscrew(
        at,
        &[
            "simulate",
            "--from",
            "out",
            "--units",
            "50",
            "--repetitions",
            "20",
            "--json",
        ],
    );
    let told: Value = serde_json::from_slice(&told.stdout).expect("JSON");
    assert_eq!(
        told["assumptions"]["screw"]["out_at_once"]["of"],
        summary["statistics"]["screws_removed"]["hits"]
    );
    assert!(told["forecast"]["cycle_mean_s"]["mean"].as_f64() > Some(60.0), "{told}");
    refused(at, &["run", "--units", "1", "--out", "out"], &["out", "--resume"]);
}
