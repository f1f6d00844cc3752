//! How a unit is drawn: sheets, screws and decoys of every face from one seed.

use crate::fastener::{CrossRecess, Decoy, Head, Item, Kind, Plating, Wear};
use crate::layer::{Layer, Sheetwork};
use crate::paint::{Coat, Paint};
use crate::product::{Cover, CoverId, FaceDesign, FaceId, Placed, Screw, ScrewId, Theme, Unit, UnitOptions};
use crate::shape::Shape;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::sync::Arc;

pub(crate) fn unit(seed: u64, options: &UnitOptions) -> Unit {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let size_mm = [
        rng.random_range(740.0..890.0),
        rng.random_range(280.0..390.0),
        rng.random_range(520.0..740.0),
    ];
    let mut next = 0u16;
    let faces: Vec<Arc<FaceDesign>> = FaceId::ALL
        .iter()
        .map(|&id| Arc::new(face(id, size_mm, options, &mut next, &mut rng)))
        .collect();
    let cover = |id: CoverId, face: FaceId, leaves_with: Option<CoverId>| Cover {
        id,
        face,
        screws: faces
            .iter()
            .filter(|f| f.id == face)
            .flat_map(|f| f.screws.iter().map(|s| s.id))
            .collect(),
        leaves_with,
    };
    let covers = vec![
        cover(CoverId::Front, FaceId::Front, None),
        cover(CoverId::Left, FaceId::Left, Some(CoverId::Front)),
        cover(CoverId::Right, FaceId::Right, None),
        cover(CoverId::Top, FaceId::Top, None),
        cover(CoverId::FrontInner, FaceId::FrontInner, None),
    ];
    Unit {
        seed,
        model: format!("RAS-{:04}", rng.random_range(1000..9999)),
        size_mm,
        theme: Theme::Clean,
        faces,
        covers,
        exclusion: None,
    }
}

pub(crate) fn gauge(seed: u64) -> Unit {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let options = UnitOptions {
        wear: 0.2,
        decoys: false,
        excluded_share: 0.0,
    };
    let mut next = 0;
    let front = face(FaceId::Front, [600.0, 30.0, 400.0], &options, &mut next, &mut rng);
    Unit {
        seed,
        model: "GAUGE".into(),
        size_mm: [600.0, 30.0, 400.0],
        theme: Theme::Clean,
        covers: Vec::new(),
        faces: vec![Arc::new(front)],
        exclusion: None,
    }
}

fn face(id: FaceId, [w, d, h]: [f64; 3], options: &UnitOptions, next: &mut u16, rng: &mut Pcg64Mcg) -> FaceDesign {
    let (width_mm, height_mm) = match id {
        FaceId::Front | FaceId::FrontInner => (w, h),
        FaceId::Left | FaceId::Right => (d, h),
        FaceId::Top => (w, d),
    };
    let mut sheetwork = Sheetwork::default();
    let paint = Paint::new(Coat::Painted, [0.62, 0.6, 0.53], 0.45, rng);
    sheetwork.layers.push(Layer::new(
        Shape::rect([0.0, 0.0], [0.5 * width_mm as f32, 0.5 * height_mm as f32], 6.0),
        0.0,
        300.0,
        3.0,
        paint,
    ));
    let count = rng.random_range(3..=6);
    let mut place = |k: usize, n: usize, rng: &mut Pcg64Mcg| {
        let t = (k as f64 + rng.random_range(0.2..0.8)) / n as f64;
        [
            (t - 0.5) * (width_mm - 40.0),
            (rng.random_range(0.0..1.0f64) - 0.5) * (height_mm - 40.0),
        ]
    };
    let screws = (0..count)
        .map(|k| {
            *next += 1;
            Screw {
                id: ScrewId(*next - 1),
                placed: Placed {
                    item: item(
                        Kind::Screw {
                            head: Head::Pan,
                            recess: CrossRecess::Phillips,
                            recess_width_mm: 4.6,
                        },
                        rng,
                    ),
                    at_mm: place(k, count, rng),
                    height_mm: 0.0,
                },
                torque_nm: 2.0,
                seized: false,
            }
        })
        .collect();
    let decoys = (0..if options.decoys { 8 } else { 0 })
        .map(|k| Placed {
            item: item(Kind::Decoy(Decoy::ALL[rng.random_range(0..Decoy::ALL.len())]), rng),
            at_mm: place(k, 8, rng),
            height_mm: 0.0,
        })
        .collect();
    FaceDesign {
        id,
        width_mm,
        height_mm,
        screws,
        decoys,
        sheetwork,
    }
}

fn item(kind: Kind, rng: &mut Pcg64Mcg) -> Item {
    Item {
        kind,
        diameter_mm: rng.random_range(7.0..12.0),
        rotation_rad: rng.random_range(0.0..std::f64::consts::TAU),
        tilt_rad: 0.0,
        tilt_direction_rad: 0.0,
        lift_mm: 0.0,
        recess_offset_mm: [0.0; 2],
        plating: Plating::Zinc,
        wear: Wear::default(),
        seed: rng.random(),
    }
}

/// The calibration jig as a face: paddle, handle, disc.
pub(crate) fn jig(seed: u64) -> FaceDesign {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut sheetwork = Sheetwork::default();
    let white = Paint::new(Coat::Plastic, [0.82, 0.82, 0.8], 0.7, &mut rng);
    let disc = Paint::new(Coat::Plastic, [0.02, 0.42, 0.1], 0.75, &mut rng);
    let paddle = Shape::rect([0.0, 0.0], [42.0, 42.0], 14.0);
    sheetwork.layers.push(Layer::new(paddle, -0.1, 6.0, 0.5, white));
    let radius = rng.random_range(10.0..15.0);
    sheetwork.layers.push(Layer::new(
        Shape::Disc {
            center: [0.0, 0.0],
            radius,
        },
        0.0,
        0.1,
        0.0,
        disc,
    ));
    FaceDesign {
        id: FaceId::Front,
        width_mm: 84.0,
        height_mm: 84.0,
        screws: Vec::new(),
        decoys: Vec::new(),
        sheetwork,
    }
}
