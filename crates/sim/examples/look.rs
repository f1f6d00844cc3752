//! Looks at every face of a unit and at the calibration marker through the device traits, and prints what a grab costs:
//! `cargo run --release -p sim --example look -- DIR [UNITS_SEED]`

use cell::device::{Devices, Motion, Region, TagValue, tags};
use geometry::{Point, write_jpeg};
use sim::{SimSettings, SimulatedCell, layout};
use std::{error::Error, path::PathBuf, time::Instant};

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let dir = PathBuf::from(args.next().ok_or("say where the pictures go: DIR [UNITS_SEED]")?);
    let units_seed = args.next().map_or(Ok(1), |s| s.parse())?;
    std::fs::create_dir_all(&dir)?;
    let cell = SimulatedCell::new(SimSettings {
        units_seed,
        ..SimSettings::default()
    });
    let devices = &cell.devices;

    cell.mount_jig(Some(0));
    let arm = &devices.arms[0].robot;
    let ticket = arm
        .move_to(layout::tool_at(Point::new(1150.0, -300.0, 600.0)), Motion::Joint)
        .await?;
    arm.wait(ticket, 10.0).await?;
    grab(devices, None, &dir, "marker").await?;
    let region = Region {
        x_px: 2980,
        y_px: 1180,
        width_px: 300,
        height_px: 300,
    };
    grab(devices, Some(region), &dir, "marker_region").await?;
    let ticket = arm.run_job(cell::device::jobs::HOME).await?;
    arm.wait(ticket, 10.0).await?;
    cell.mount_jig(None);

    devices.io.write(tags::FEED, TagValue::Bool(true)).await?;
    devices.io.wait_for(tags::LOADED, TagValue::Bool(true), 60.0).await?;
    for face in ["front", "left", "right", "top"] {
        devices.io.write(tags::PRESENT, TagValue::Text(face.into())).await?;
        devices
            .io
            .wait_for(tags::PRESENTED, TagValue::Text(face.into()), 30.0)
            .await?;
        grab(devices, None, &dir, face).await?;
        let region = Region {
            x_px: 1900,
            y_px: 1400,
            width_px: 256,
            height_px: 256,
        };
        grab(devices, Some(region), &dir, &format!("{face}_region")).await?;
    }
    for unit in cell.score().units {
        println!("{} of theme {:?}: {} screws", unit.model, unit.theme, unit.screws.len());
    }
    Ok(())
}

async fn grab(
    devices: &Devices,
    region: Option<Region>,
    dir: &std::path::Path,
    name: &str,
) -> Result<(), Box<dyn Error>> {
    let begin = (Instant::now(), devices.clock.now_s());
    let color = devices.color.grab(region).await?;
    let depth = devices.depth.grab(region).await?;
    let (real, simulated) = (begin.0.elapsed().as_secs_f64(), devices.clock.now_s() - begin.1);
    let holes = depth.map.depth_mm.iter().filter(|z| **z <= 0.0).count() as f64 / depth.map.depth_mm.len() as f64;
    println!(
        "{name}: {simulated:.2} s in the cell, {real:.2} s here, {:.1} % of the depth missing",
        100.0 * holes
    );
    write_jpeg(&dir.join(format!("{name}.jpg")), &color.image, 90)?;
    Ok(())
}
