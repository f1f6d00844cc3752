//! Renders faces to look at: `cargo run --release -p scene --example face -- SEED FACE OUT.png [overlay]`;
//! with `crops` for FACE, a sheet of every screw (and, in red frames, every decoy) of units from SEED on, 48 px each, truth marked.

use scene::{FaceId, FaceView, Prepared, Unit};
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [seed, face, out, rest @ ..] = args.as_slice() else {
        return Err("usage: face SEED front|left|right|top|front_inner OUT.png [overlay]".into());
    };
    let seed: u64 = seed.parse()?;
    if face == "crops" {
        return crops(seed, Path::new(out), rest.iter().any(|a| a == "overlay"));
    }
    let face = FaceId::ALL
        .into_iter()
        .find(|f| f.name() == face)
        .ok_or_else(|| format!("no face is called {face}"))?;
    let unit = Unit::sample(seed);
    let view = FaceView::sample(&unit, face, seed).ok_or("the unit has no such face")?;
    let start = std::time::Instant::now();
    let prepared = Prepared::new(&view);
    let mut picture = prepared.render(None).color;
    eprintln!(
        "{}: {} mm, {:?}, {:.2} s",
        unit.model,
        unit.size_mm.map(|v| v.round().to_string()).join(" x "),
        unit.theme,
        start.elapsed().as_secs_f64()
    );
    if rest.iter().any(|a| a == "overlay") {
        let truth = prepared.truth();
        for screw in &truth.screws {
            let color = if screw.detectable { [0, 255, 0] } else { [255, 160, 0] };
            ring(
                &mut picture,
                screw.pixel.u_px,
                screw.pixel.v_px,
                0.7 * screw.head_d_px,
                color,
            );
            eprintln!(
                "screw {} at {:.1} {:.1} d {:.1} px seen {:.2} slot {:.2} {:?}",
                screw.id.0,
                screw.pixel.u_px,
                screw.pixel.v_px,
                screw.head_d_px,
                screw.visible_fraction,
                screw.slot_visible_fraction,
                screw.wear
            );
        }
        for decoy in &truth.decoys {
            ring(
                &mut picture,
                decoy.pixel.u_px,
                decoy.pixel.v_px,
                0.7 * decoy.d_px,
                [255, 0, 0],
            );
        }
    }
    geometry::write_png(Path::new(out), &picture)?;
    Ok(())
}

fn ring(picture: &mut geometry::RgbImage, u: f64, v: f64, radius: f64, color: [u8; 3]) {
    for k in 0..720 {
        let angle = f64::from(k) * std::f64::consts::PI / 360.0;
        for r in [radius, radius + 1.0, radius + 2.0] {
            let (x, y) = (u + r * angle.cos(), v + r * angle.sin());
            if x >= 0.0 && y >= 0.0 && x < f64::from(picture.width()) && y < f64::from(picture.height()) {
                picture.put_pixel(x as u32, y as u32, image::Rgb(color));
            }
        }
    }
}

fn crops(first: u64, out: &Path, marked: bool) -> Result<(), Box<dyn std::error::Error>> {
    const SIDE: u32 = 48;
    const ZOOM: u32 = 2;
    const COLUMNS: u32 = 16;
    const ROWS: u32 = 10;
    let tile = SIDE * ZOOM;
    let mut sheet = geometry::RgbImage::new(COLUMNS * tile, ROWS * tile);
    let mut k = 0;
    let start = std::time::Instant::now();
    'units: for seed in first.. {
        let unit = Unit::sample(seed);
        for face in FaceId::ALL {
            let view = FaceView::sample(&unit, face, seed).ok_or("no such face")?;
            let prepared = Prepared::new(&view);
            let truth = prepared.truth();
            let screws = truth.screws.iter().map(|s| (s.pixel, true));
            let decoys = truth.decoys.iter().map(|d| (d.pixel, false));
            for (pixel, screw) in screws.chain(decoys.take(2)) {
                if k >= COLUMNS * ROWS {
                    break 'units;
                }
                let roi = scene::Roi::around(&view.camera, pixel, SIDE);
                let crop = prepared.render(Some(roi)).color;
                let filter = image::imageops::FilterType::CatmullRom;
                let mut big = image::imageops::resize(&crop, tile, tile, filter);
                if marked && screw {
                    let at = |p: f64, o: u32| ((p - f64::from(o) + 0.5) * f64::from(ZOOM)) as u32;
                    let (u, v) = (at(pixel.u_px, roi.x_px), at(pixel.v_px, roi.y_px));
                    if u < tile && v < tile {
                        big.put_pixel(u, v, image::Rgb([0, 255, 0]));
                    }
                }
                for x in 0..tile {
                    big.put_pixel(x, 0, image::Rgb(if screw { [0, 0, 0] } else { [255, 0, 0] }));
                }
                image::imageops::replace(
                    &mut sheet,
                    &big,
                    i64::from(k % COLUMNS * tile),
                    i64::from(k / COLUMNS * tile),
                );
                k += 1;
            }
        }
    }
    eprintln!("{k} regions in {:.2} s", start.elapsed().as_secs_f64());
    geometry::write_png(out, &sheet)?;
    Ok(())
}
