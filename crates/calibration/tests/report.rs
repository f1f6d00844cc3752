//! What a diagnosis says of captures that are good, short, drifting, or spoiled in one corner.

mod arm;

use arm::{gp, pairs};
use calibration::{Settings, diagnose, volume_covered};
use geometry::Point;
use nalgebra::Vector3;

#[test]
fn a_good_capture_is_called_good() -> Result<(), Box<dyn std::error::Error>> {
    let (map, d) = diagnose(&pairs(1, 120), &gp())?;
    assert_eq!(d.visits.len(), 120);
    assert!(d.visits.iter().all(|v| v.mapped.is_some()));
    assert!(d.held_out.total.rms_mm < 0.15 && d.held_out.n >= 118, "{}", d.held_out);
    assert!(
        (0.6..0.78).contains(&d.coverage[0]) && (0.9..0.99).contains(&d.coverage[1]),
        "{:?}",
        d.coverage
    );
    assert!(d.split_half.expect("two halves").rms_mm < 0.2);
    let rms: Vec<f64> = d.fewer.iter().map(|f| f.figures.total.rms_mm).collect();
    assert!(rms.len() >= 4 && rms[0] > 1.3 * rms[rms.len() - 1], "{rms:?}");
    assert_eq!(d.octants.iter().map(|o| o.n).sum::<usize>(), d.held_out.n);
    assert!(!d.advice.iter().any(|a| a.contains("drift")), "{:?}", d.advice);
    assert!(volume_covered(&map) > 0.8);
    Ok(())
}

#[test]
fn drift_and_a_bad_corner_are_named() -> Result<(), Box<dyn std::error::Error>> {
    let moved = |by: &dyn Fn(&calibration::Pair) -> Vector3<f64>| {
        let mut pairs = pairs(2, 150);
        for pair in &mut pairs {
            let camera = pair.camera.expect("seen").vector();
            pair.camera = Some(Point::from_vector(camera + by(pair)));
        }
        diagnose(&pairs, &Settings::default())
    };
    // an arm that warms up by 0.4 mm over a quarter of an hour
    let (_, warm) = moved(&|p| Vector3::new(0.4 * p.t_s / 900.0, 0.0, 0.0))?;
    assert!(
        warm.advice.iter().any(|a| a.contains("drift by 0.")),
        "{:?}",
        warm.advice
    );
    assert!(warm.drift.expect("times").largest().1 > 4.0);
    // light that spoils the measurements in one corner
    let (_, corner) = moved(&|p| {
        let c = p.command;
        let there = c.x_mm() > 1150.0 && c.y_mm() > 0.0 && c.z_mm() > 525.0;
        let jump = ((p.id * 7919 % 13) as f64 / 6.0 - 1.0) * if there { 0.35 } else { 0.0 };
        Vector3::new(jump, -jump, 0.0)
    })?;
    let said = corner.advice.iter().any(|a| a.contains("high x, high y and high z"));
    assert!(said, "{:?}", corner.advice);
    Ok(())
}
