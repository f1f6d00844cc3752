//! How a unit is drawn: sheets, screws and decoys of every face from one seed.

mod draft;
mod inner;
mod outer;
mod sheet;
mod style;

use crate::layer::{Bump, Layer, Sheetwork};
use crate::paint::{Coat, Paint};
use crate::product::{Cover, CoverId, Exclusion, FaceDesign, FaceId, Theme, Unit, UnitOptions};
use crate::shape::{Bounds, Shape, Xy};
use draft::Draft;
use inner::front_inner;
use outer::{front, side, top};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::f64::consts::TAU;
use std::sync::Arc;
use style::Style;

type Rng = Pcg64Mcg;

fn pick<T: Copy>(rng: &mut Rng, from: &[T]) -> T {
    from[rng.random_range(0..from.len())]
}

fn varied(color: [f32; 3], by: f32, rng: &mut Rng) -> [f32; 3] {
    let all = 1.0 + rng.random_range(-by..by);
    color.map(|c| (c * all * (1.0 + rng.random_range(-0.2..0.2) * by)).clamp(0.02, 0.88))
}

fn strip(low: Xy, high: Xy) -> Shape {
    Shape::rect(
        [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])],
        [0.5 * (high[0] - low[0]), 0.5 * (high[1] - low[1])],
        1.0,
    )
}

fn bounds(low: Xy, high: Xy) -> Bounds {
    Bounds { low, high }
}

pub(crate) fn unit(seed: u64, options: &UnitOptions) -> Unit {
    let mut rng = Rng::seed_from_u64(seed);
    let size_mm: [f64; 3] = [
        rng.random_range(640.0..895.0),
        rng.random_range(250.0..395.0),
        rng.random_range(500.0..745.0),
    ];
    let style = Style::sample(options, &mut rng);
    let [w, d, h] = size_mm;
    let mut next = 0u16;
    let mut faces = vec![
        front(&style, w, h, d, &mut next, &mut rng),
        side(&style, FaceId::Left, d, h, w, &mut next, &mut rng),
        side(&style, FaceId::Right, d, h, w, &mut next, &mut rng),
        top(&style, w, d, h, &mut next, &mut rng),
        front_inner(&style, w, h, d, &mut next, &mut rng),
    ];
    if !options.decoys {
        for face in &mut faces {
            face.decoys.clear();
        }
    }
    let exclusion = rng
        .random_bool(options.excluded_share.clamp(0.0, 1.0))
        .then(|| exclude(&mut faces, &mut rng));
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
        model: style.model.clone(),
        size_mm,
        theme: style.theme,
        faces: faces.into_iter().map(Arc::new).collect(),
        covers,
        exclusion,
    }
}

/// Spoils a unit as those were that the paper excluded.
fn exclude(faces: &mut [FaceDesign], rng: &mut Rng) -> Exclusion {
    let kind = pick(
        rng,
        &[
            Exclusion::MudFilledSlot,
            Exclusion::DenseWeb,
            Exclusion::Seized,
            Exclusion::BentCover,
        ],
    );
    let face = &mut faces[rng.random_range(0..5)];
    let count = face.screws.len();
    if count == 0 {
        return kind;
    }
    match kind {
        Exclusion::BentCover => {
            let toward = rng.random_range(0.0..TAU);
            let lean = rng.random_range(10.0..16.0f64).to_radians();
            for screw in &mut face.screws {
                screw.placed.item.tilt_rad = lean * rng.random_range(0.8..1.1);
                screw.placed.item.tilt_direction_rad = toward;
            }
            if let Some(layer) = face.sheetwork.layers.first_mut() {
                let center = [rng.random_range(-150.0..150.0), rng.random_range(-80.0..80.0)];
                layer.bumps.push(Bump::Dent {
                    center,
                    radius: rng.random_range(60.0..140.0),
                    height: -rng.random_range(8.0..16.0f32),
                });
            }
        }
        _ => {
            for _ in 0..rng.random_range(1..=3) {
                let screw = &mut face.screws[rng.random_range(0..count)];
                let wear = &mut screw.placed.item.wear;
                match kind {
                    Exclusion::MudFilledSlot => {
                        wear.mud_in_slot = 1.0;
                        wear.dirt = wear.dirt.max(0.85);
                    }
                    Exclusion::DenseWeb => wear.web = 1.0,
                    _ => {
                        wear.rust = wear.rust.max(0.9);
                        screw.seized = true;
                        screw.torque_nm = rng.random_range(9.0..20.0);
                    }
                }
            }
        }
    }
    kind
}

pub(crate) fn gauge(seed: u64) -> Unit {
    let mut rng = Rng::seed_from_u64(seed);
    let options = UnitOptions {
        wear: 0.12,
        decoys: false,
        excluded_share: 0.0,
    };
    let mut style = Style::sample(&options, &mut rng);
    style.theme = Theme::Clean;
    let size_mm = [rng.random_range(420.0..640.0), 20.0, rng.random_range(300.0..460.0)];
    let mut draft = Draft::new(&style, size_mm[0], size_mm[2]);
    let paint = if rng.random_bool(0.5) {
        style.zinc(&mut rng)
    } else {
        style.paint(&mut rng)
    };
    let [w, h] = draft.half;
    let plate = draft.add(Layer::new(Shape::rect([0.0, 0.0], [w, h], 4.0), 0.0, 20.0, 1.0, paint));
    draft.seam(plate, bounds([-w + 10.0, -h + 10.0], [w - 10.0, h - 10.0]));
    draft.put_screws(30, &mut rng);
    let mut next = 0;
    let face = draft.finish(FaceId::Front, size_mm[0], size_mm[2], &mut next, &mut rng);
    Unit {
        seed,
        model: "GAUGE".into(),
        size_mm,
        theme: Theme::Clean,
        covers: Vec::new(),
        faces: vec![Arc::new(face)],
        exclusion: None,
    }
}

/// The calibration jig as a face: paddle, handle, disc.
pub(crate) fn jig(seed: u64) -> FaceDesign {
    let mut rng = Rng::seed_from_u64(seed);
    let mut sheetwork = Sheetwork::default();
    let white = Paint::new(Coat::Plastic, [0.82, 0.82, 0.8], 0.7, &mut rng);
    let ink = pick(&mut rng, &[[0.02, 0.40, 0.08], [0.62, 0.02, 0.36], [0.03, 0.38, 0.10]]);
    let disc = Paint::new(Coat::Plastic, ink, 0.75, &mut rng);
    let steel = Paint::new(Coat::Zinc, [0.5; 3], 0.4, &mut rng);
    let radius = rng.random_range(11.0..15.0f32);
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
    let side = radius + rng.random_range(16.0..26.0);
    sheetwork.layers.push(Layer::new(
        Shape::rect([0.0, 0.0], [side, side], 0.4 * side),
        -0.1,
        6.0,
        0.5,
        white,
    ));
    sheetwork.layers.push(Layer::new(
        strip([-9.0, side - 4.0], [9.0, side + 160.0]),
        -2.0,
        14.0,
        3.0,
        steel,
    ));
    FaceDesign {
        id: FaceId::Front,
        width_mm: f64::from(2.0 * side),
        height_mm: f64::from(2.0 * side),
        screws: Vec::new(),
        decoys: Vec::new(),
        sheetwork,
    }
}
