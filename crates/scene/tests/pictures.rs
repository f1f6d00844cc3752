//! What pictures and their truth promise.

use geometry::Pixel;
use scene::{FaceId, FaceView, MarkerView, Prepared, Roi, Sensor, Unit, UnitOptions, render_marker};

fn clean_view(seed: u64) -> FaceView {
    let options = UnitOptions {
        wear: 0.0,
        decoys: false,
        excluded_share: 0.0,
    };
    FaceView::sample(&Unit::sample_with(seed, &options), FaceId::Front, seed).expect("every unit has a front")
}

#[test]
fn units_are_within_the_envelope_and_have_15_to_30_screws() {
    let mut excluded = 0;
    for seed in 0..60 {
        let unit = Unit::sample(seed);
        let [w, d, h] = unit.size_mm;
        assert!(w <= 900.0 && d <= 400.0 && h <= 750.0, "{:?}", unit.size_mm);
        let count = unit.screws().count();
        assert!((15..=30).contains(&count), "seed {seed}: {count} screws");
        for (_, screw) in unit.screws() {
            let d = screw.placed.item.diameter_mm;
            assert!((7.0..=12.0).contains(&d), "head of {d} mm");
            assert!(unit.cover_of(screw.id).is_some());
        }
        excluded += usize::from(unit.exclusion.is_some());
    }
    assert!((5..=25).contains(&excluded), "{excluded} of 60 excluded, 14 expected");
}

#[test]
fn poses_are_within_their_limits_and_the_face_is_in_the_picture() {
    let unit = Unit::sample(3);
    for seed in 0..40 {
        let view = FaceView::sample(&unit, FaceId::Front, seed).expect("front");
        let z = view.camera_from_face.isometry().rotation * nalgebra::Vector3::z();
        assert!(z.angle(&nalgebra::Vector3::z()).to_degrees() < 6.01);
        let x = view.camera_from_face.isometry().rotation * nalgebra::Vector3::x();
        assert!(x.y.atan2(x.x).to_degrees().abs() < 4.5);
        let (w, h) = (0.5 * view.design.width_mm, 0.5 * view.design.height_mm);
        for (sx, sy) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
            let corner = view
                .camera
                .project(view.camera_point(sx * w, sy * h, 0.0))
                .expect("in front");
            assert!(view.camera.contains(corner), "seed {seed}: corner at {corner:?}");
        }
    }
}

#[test]
fn a_region_has_the_pixels_of_a_larger_one_and_threads_do_not_matter() {
    let unit = Unit::sample(8);
    let view = FaceView::sample(&unit, FaceId::Right, 5).expect("right");
    let at = view.item_pixels()[0];
    let large = Roi::around(&view.camera, at, 200);
    let small = Roi {
        x_px: large.x_px + 46,
        y_px: large.y_px + 58,
        width_px: 97,
        height_px: 81,
    };
    let whole = scene::render(&view, Some(large));
    let alone = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .expect("a pool")
        .install(|| scene::render(&view, Some(small)));
    for (x, y, pixel) in alone.color.enumerate_pixels() {
        assert_eq!(pixel, whole.color.get_pixel(x + 46, y + 58), "at {x} {y}");
    }
    for j in 0..alone.depth.height {
        for i in 0..alone.depth.width {
            assert_eq!(alone.depth.at(i, j), whole.depth.at(i + 23, j + 29), "depth at {i} {j}");
        }
    }
}

#[test]
fn truth_is_where_the_slot_is() {
    // Looked at straight from above, nothing of the slot hides another part: its centroid in depth is its centre.
    let mut off = Vec::new();
    for seed in 0..5 {
        let mut view = clean_view(seed);
        view.camera.distortion = [0.0; 5];
        for screw in view.design.clone().screws.iter().take(4) {
            let [x, y] = screw.placed.at_mm;
            view.camera_from_face =
                geometry::Transform::from_parts([0.37 - x, -0.21 - y, 1200.0], nalgebra::UnitQuaternion::identity());
            let prepared = Prepared::new(&view);
            let truth = prepared.truth();
            let Some(screw) = truth
                .screws
                .iter()
                .find(|s| s.id == screw.id && s.slot_visible_fraction > 0.99)
            else {
                continue;
            };
            let roi = Roi::around(&view.camera, screw.pixel, 64);
            let depth = prepared.render_ideal(Some(roi)).depth;
            let (mut su, mut sv, mut sw) = (0.0, 0.0, 0.0);
            for j in 0..depth.height {
                for i in 0..depth.width {
                    let at = depth.color_pixel(i, j);
                    let (u, v) = (at.u_px + f64::from(roi.x_px), at.v_px + f64::from(roi.y_px));
                    let inside = (u - screw.pixel.u_px).hypot(v - screw.pixel.v_px) < 0.33 * screw.head_d_px;
                    let below = depth.at(i, j).map_or(0.0, |z| z - screw.point.z_mm());
                    if inside && below > 0.3 {
                        su += u * below.min(1.0);
                        sv += v * below.min(1.0);
                        sw += below.min(1.0);
                    }
                }
            }
            assert!(sw > 5.0, "no slot seen");
            off.push((su / sw - screw.pixel.u_px).hypot(sv / sw - screw.pixel.v_px));
        }
    }
    off.sort_by(f64::total_cmp);
    let median = off[off.len() / 2];
    assert!(off.len() > 12 && median < 0.3, "median {median:.2} of {off:.2?}");
    // domes fall away under wide slots, and depth has half the resolution
    assert!(off[off.len() * 9 / 10] < 0.6, "{off:.2?}");
}

#[test]
fn truth_lies_in_the_plane_of_the_rim() {
    // Seen obliquely, the depth around the slot is that of the truth, and its pixel is the projection of its point.
    let mut off = Vec::new();
    for seed in 10..14 {
        let view = clean_view(seed);
        let prepared = Prepared::new(&view);
        for screw in prepared.truth().screws.iter().filter(|s| s.visible_fraction > 0.99) {
            let back = view.camera.project(screw.point).expect("in front");
            assert!(back.distance_px(&screw.pixel) < 1e-6);
            let roi = Roi::around(&view.camera, screw.pixel, 64);
            let depth = prepared.render_ideal(Some(roi)).depth;
            let local = Pixel::new(
                screw.pixel.u_px - f64::from(roi.x_px),
                screw.pixel.v_px - f64::from(roi.y_px),
            );
            let mut around: Vec<f64> = depth
                .neighbourhood(local, 0.0, 0.33 * screw.head_d_px)
                .iter()
                .map(|p| p[2] - screw.point.z_mm())
                .collect();
            around.sort_by(f64::total_cmp);
            off.push(around[around.len() / 8].abs());
        }
    }
    off.sort_by(f64::total_cmp);
    assert!(off.len() > 12 && off[off.len() / 2] < 0.25, "{off:.2?}");
}

#[test]
fn depth_is_that_of_the_sheet_with_the_stated_noise() {
    let unit = Unit::gauge(4);
    let view = FaceView::sample(&unit, FaceId::Front, 6).expect("gauge");
    let prepared = Prepared::new(&view);
    let truth = prepared.truth();
    let (mut errors, mut holes, mut all) = (Vec::new(), 0, 0);
    for screw in truth.screws.iter().take(12) {
        let roi = Roi::around(&view.camera, screw.pixel, 96);
        let real = prepared.render(Some(roi)).depth;
        let ideal = prepared.render_ideal(Some(roi)).depth;
        for (a, b) in real.depth_mm.iter().zip(&ideal.depth_mm) {
            all += 1;
            if *a <= 0.0 {
                holes += 1;
            } else {
                errors.push(f64::from(a - b));
            }
        }
    }
    let n = errors.len() as f64;
    let mean = errors.iter().sum::<f64>() / n;
    let sigma = (errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n).sqrt();
    assert!(mean.abs() < 0.8, "bias {mean}");
    assert!((0.18..0.5).contains(&sigma), "noise {sigma}");
    assert!(holes * 2 < all, "{holes} holes of {all}");
}

#[test]
fn removed_screws_leave_holes_in_truth_and_picture() {
    let mut view = clean_view(9);
    let before = scene::truth(&view);
    let gone = before.screws[0].clone();
    view.removed_screws.push(gone.id);
    let prepared = Prepared::new(&view);
    let after = prepared.truth();
    assert_eq!(after.screws.len(), before.screws.len() - 1);
    assert!(after.decoys.iter().any(|d| d.pixel.distance_px(&gone.pixel) < 6.0));
    let roi = Some(Roi::around(&view.camera, gone.pixel, 48));
    let there = scene::render(&clean_view(9), roi).color;
    assert_ne!(prepared.render(roi).color, there);
}

#[test]
fn the_marker_is_where_it_is_said_to_be() {
    let camera = scene::camera(1);
    for (k, offset) in [[0.0, 0.0, 1450.0], [300.0, -200.0, 1350.0]].into_iter().enumerate() {
        let view = MarkerView {
            camera,
            camera_from_marker: geometry::Transform::from_parts(
                offset,
                nalgebra::UnitQuaternion::from_euler_angles(0.08, -0.05, 0.4),
            ),
            scene_seed: 7,
            sensor: Sensor::sample(k as u64),
        };
        let center = camera
            .project(geometry::Point::new(offset[0], offset[1], offset[2]))
            .expect("in front");
        let roi = Roi::around(&camera, center, 160);
        let picture = render_marker(&view, Some(roi)).color;
        // saturation of the disc against the white paddle
        let (mut su, mut sv, mut sw) = (0.0, 0.0, 0.0);
        for (x, y, p) in picture.enumerate_pixels() {
            let (u, v) = (f64::from(x + roi.x_px), f64::from(y + roi.y_px));
            let spread = f64::from(*p.0.iter().max().unwrap_or(&0)) - f64::from(*p.0.iter().min().unwrap_or(&0));
            if spread > 60.0 && (u - center.u_px).hypot(v - center.v_px) < 75.0 {
                su += u;
                sv += v;
                sw += 1.0;
            }
        }
        assert!(sw > 800.0, "a disc of {sw} pixels");
        let off = (su / sw - center.u_px).hypot(sv / sw - center.v_px);
        assert!(off < 0.5, "off by {off:.2} px");
    }
}
