//! The calibration marker: a coloured disc on a white paddle, found by colour and area, measured by its outline.

use std::f64::consts::{PI, TAU};
use std::ops::RangeInclusive;

use geometry::{Camera, Pixel, Point, RgbdFrame};
use image::RgbImage;

use crate::center::fit_harmonics;
use crate::components::{Run, area, components};
use crate::picture::Patch;

/// What the marker looks like.
#[derive(Clone, Debug, PartialEq)]
pub struct MarkerSpec {
    /// Hue of the disc, degrees (0 red, 120 green, 240 blue).
    pub hue_deg: RangeInclusive<f64>,
    /// Least saturation, 0 to 1.
    pub min_saturation: f64,
    /// Least brightness, 0 to 1.
    pub min_value: f64,
    /// Diameter that the disc can have in the picture, px.
    pub diameter_px: RangeInclusive<f64>,
    /// A disc with a softer edge than this (standard deviation) is blurred, px.
    pub max_blur_px: f64,
}

impl Default for MarkerSpec {
    fn default() -> Self {
        Self {
            hue_deg: 95.0..=170.0,
            min_saturation: 0.4,
            min_value: 0.12,
            diameter_px: 20.0..=400.0,
            max_blur_px: 3.0,
        }
    }
}

/// The marker in a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Marker {
    /// Centre of the disc's outline.
    pub pixel: Pixel,
    /// Standard error of the centre along each axis, px.
    pub sigma_px: f64,
    /// Mean diameter, px.
    pub diameter_px: f64,
    /// Longer and shorter axis of the outline, px.
    pub axes_px: [f64; 2],
    /// Direction of the longer axis, rad.
    pub direction_rad: f64,
    /// Softness of its edge (standard deviation), px.
    pub blur_px: f64,
}

/// The marker in space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocatedMarker {
    /// In the picture.
    pub marker: Marker,
    /// Depth of the disc's plane at its centre, mm.
    pub depth_mm: f64,
    /// Standard error of the depth, mm.
    pub sigma_depth_mm: f64,
    /// Centre of the disc.
    pub point: Point<Camera>,
}

/// Why there is no measurement of the marker.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum MarkerError {
    /// Nothing of its colour.
    #[error("no marker in the picture: check that it faces the camera and that the light shows its colour")]
    NotFound,
    /// More than one disc of its colour.
    #[error("{count} discs of the marker's colour in the picture: cover all but the marker, or narrow the region")]
    Several {
        /// Discs found.
        count: usize,
    },
    /// A disc of its colour, but not of its size.
    #[error(
        "a disc of the marker's colour has {found_px:.1} px instead of {least_px:.0} to {most_px:.0}: check the distance and the marker's size"
    )]
    WrongSize {
        /// Its diameter, px.
        found_px: f64,
        /// Least expected, px.
        least_px: f64,
        /// Most expected, px.
        most_px: f64,
    },
    /// Part of its outline is missing.
    #[error("the marker is partly hidden or leaves the picture: {visible_percent:.0} % of its outline show")]
    PartlyHidden {
        /// Share of the outline that was found, %.
        visible_percent: f64,
    },
    /// Its edge is soft.
    #[error("the marker is blurred by {blur_px:.1} px: wait until the arm stands still, or check the focus")]
    Blurred {
        /// Standard deviation of the edge, px.
        blur_px: f64,
    },
    /// It was found, but there is no depth on it.
    #[error(
        "no depth on the marker at ({u_px:.0}, {v_px:.0}) px: check the depth camera, and that the marker does not shine"
    )]
    NoDepth {
        /// Where it is.
        u_px: f64,
        /// Where it is.
        v_px: f64,
    },
}

/// Rays on which the outline is measured.
const RAYS: usize = 96;
/// Share of the outline that must show.
const MIN_VISIBLE: f64 = 0.88;

/// Roundness of a component that counts as a disc; half a disc has 0.946.
const MIN_ROUNDNESS: f64 = 0.965;

/// Finds the marker by colour and area, and measures the centre of its outline to a few hundredths of a pixel.
///
/// # Errors
/// A [`MarkerError`] for every abnormal case; there is no measurement then.
pub fn find_marker(picture: &RgbImage, spec: &MarkerSpec) -> Result<Marker, MarkerError> {
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let raw = picture.as_raw();
    let inside = |x: usize, y: usize| {
        let at = 3 * (y * width + x);
        coloured([raw[at], raw[at + 1], raw[at + 2]], spec)
    };
    let (least_px, most_px) = (*spec.diameter_px.start(), *spec.diameter_px.end());
    let mut blobs: Vec<Blob> = components(width, height, inside)
        .iter()
        .filter(|runs| area(runs) >= 16)
        .map(|runs| Blob::new(runs))
        .collect();
    blobs.sort_by(|a, b| b.diameter_px.total_cmp(&a.diameter_px));
    // A little outside the limits still counts as a disc, so that its size can be told.
    let near = |b: &&Blob| (0.8 * least_px..1.25 * most_px).contains(&b.diameter_px);
    let discs: Vec<&Blob> = blobs
        .iter()
        .filter(|b| b.roundness > MIN_ROUNDNESS)
        .filter(near)
        .collect();
    let disc = match discs[..] {
        [disc] => disc,
        [] => {
            let largest = blobs.first().ok_or(MarkerError::NotFound)?;
            return Err(if near(&largest) {
                let shape = MarkerError::PartlyHidden {
                    visible_percent: 100.0 * largest.roundness,
                };
                measure(picture, largest).err().unwrap_or(shape)
            } else if largest.diameter_px < 0.3 * least_px {
                MarkerError::NotFound // specks
            } else {
                MarkerError::WrongSize {
                    found_px: largest.diameter_px,
                    least_px,
                    most_px,
                }
            });
        }
        _ => return Err(MarkerError::Several { count: discs.len() }),
    };
    let marker = measure(picture, disc)?;
    if !spec.diameter_px.contains(&marker.diameter_px) {
        return Err(MarkerError::WrongSize {
            found_px: marker.diameter_px,
            least_px,
            most_px,
        });
    }
    if marker.blur_px > spec.max_blur_px {
        return Err(MarkerError::Blurred {
            blur_px: marker.blur_px,
        });
    }
    Ok(marker)
}

/// Finds the marker in a shot, and its centre in space.
///
/// # Errors
/// Those of [`find_marker`]; [`MarkerError::NoDepth`] where the shot has no depth there, or no camera model.
pub fn locate_marker(frame: &RgbdFrame, spec: &MarkerSpec) -> Result<LocatedMarker, MarkerError> {
    let marker = find_marker(&frame.color, spec)?;
    let no_depth = MarkerError::NoDepth {
        u_px: marker.pixel.u_px,
        v_px: marker.pixel.v_px,
    };
    let (Some(depth), Some(camera)) = (&frame.depth, &frame.camera) else {
        return Err(no_depth);
    };
    // The disc lies in the paddle's plane; its rim stays out, as depth is poor where the colour changes.
    let plane = depth
        .plane_at(marker.pixel, 0.0, 0.45 * marker.diameter_px)
        .ok_or(no_depth)?;
    Ok(LocatedMarker {
        marker,
        depth_mm: plane.depth_mm,
        sigma_depth_mm: plane.sigma_mm,
        point: camera.unproject(marker.pixel, plane.depth_mm),
    })
}

/// True for a pixel of the marker's colour.
#[inline]
fn coloured([r, g, b]: [u8; 3], spec: &MarkerSpec) -> bool {
    let (highest, lowest) = (r.max(g).max(b), r.min(g).min(b));
    let range = f64::from(highest - lowest);
    if range < spec.min_saturation * f64::from(highest) || f64::from(highest) < 255.0 * spec.min_value || range == 0.0 {
        return false;
    }
    let [r, g, b] = [r, g, b].map(f64::from);
    let hue = if highest == g as u8 {
        120.0 + 60.0 * (b - r) / range
    } else if highest == b as u8 {
        240.0 + 60.0 * (r - g) / range
    } else {
        (60.0 * (g - b) / range).rem_euclid(360.0)
    };
    spec.hue_deg.contains(&hue)
}

/// Moments of a component.
struct Blob {
    center: Pixel,
    /// Of the disc with its area.
    diameter_px: f64,
    /// Its area over that of the ellipse with its second moments: 1 for a full ellipse.
    roundness: f64,
}

impl Blob {
    fn new(runs: &[Run]) -> Self {
        let (mut n, mut u, mut v, mut uu, mut uv, mut vv) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for run in runs {
            let y = run.y as f64;
            for x in run.start..run.end {
                let x = x as f64;
                n += 1.0;
                u += x;
                v += y;
                uu += x * x;
                uv += x * y;
                vv += y * y;
            }
        }
        let (u, v) = (u / n, v / n);
        let (uu, uv, vv) = (uu / n - u * u, uv / n - u * v, vv / n - v * v);
        let ellipse = 4.0 * PI * (uu * vv - uv * uv).max(1e-9).sqrt();
        Self {
            center: Pixel::new(u, v),
            diameter_px: (4.0 * n / PI).sqrt(),
            roundness: (n / ellipse).min(1.0),
        }
    }
}

/// Measures the outline of a disc: on each ray, where the colour is half way between the disc's and the paddle's there.
fn measure(picture: &RgbImage, disc: &Blob) -> Result<Marker, MarkerError> {
    let mut radius = 0.5 * disc.diameter_px;
    let inside = mean_colour(picture, disc.center, 0.0, 0.6 * radius);
    let paddle = mean_colour(picture, disc.center, 1.2 * radius, 1.4 * radius);
    let axis: [f32; 3] = std::array::from_fn(|c| inside[c] - paddle[c]);
    let length = axis.iter().map(|a| a * a).sum::<f32>().max(1.0);
    // 1 on the disc, 0 on the paddle: the direction between the two colours leaves most of the light's changes out.
    let patch = Patch::cut_as(picture, disc.center, (1.6 * radius).ceil() as usize + 3, |rgb| {
        (0..3).map(|c| (rgb[c] - paddle[c]) * axis[c]).sum::<f32>() / length
    });
    let [mut x, mut y] = patch.local(disc.center);
    let mut measured = None;
    for _ in 0..4 {
        let mut points = Vec::with_capacity(RAYS);
        let mut widths = Vec::with_capacity(RAYS);
        for ray in 0..RAYS {
            let angle = TAU * ray as f64 / RAYS as f64;
            if let Some((r, width)) = boundary(&patch, [x, y], angle, radius)
                && in_picture(picture, patch.to_image([x + r * angle.cos(), y + r * angle.sin()]))
            {
                points.push((angle, r, 1.0));
                widths.push(width);
            }
        }
        let hidden = |visible: f64| MarkerError::PartlyHidden {
            visible_percent: 100.0 * visible,
        };
        let found = points.len() as f64 / RAYS as f64;
        let outline = fit_harmonics(&points, RAYS, radius, 0.12 * radius).ok_or(hidden(found))?;
        (x, y, radius) = (x + outline.dx, y + outline.dy, outline.radius);
        let middle = widths.len() / 2;
        let blur_px = *widths.select_nth_unstable_by(middle, f64::total_cmp).1;
        if outline.coverage < MIN_VISIBLE {
            measured = Some(Err(hidden(outline.coverage)));
            continue; // the next pass, from a better centre, may see more
        }
        measured = Some(Ok(Marker {
            pixel: patch.to_image([x, y]),
            sigma_px: outline.sigma.max(0.01),
            diameter_px: 2.0 * radius,
            axes_px: [2.0 * (radius + outline.flattening), 2.0 * (radius - outline.flattening)],
            direction_rad: outline.direction_rad,
            blur_px,
        }));
    }
    measured.unwrap_or(Err(MarkerError::NotFound))
}

fn in_picture(picture: &RgbImage, pixel: Pixel) -> bool {
    let within = |c: f64, size: u32| c > 0.0 && c < f64::from(size) - 1.0;
    within(pixel.u_px, picture.width()) && within(pixel.v_px, picture.height())
}

/// Where a ray leaves the disc, and the softness of the edge there; `None` where something else is in the way.
fn boundary(patch: &Patch, [x, y]: [f64; 2], angle: f64, radius: f64) -> Option<(f64, f64)> {
    let (sin, cos) = angle.sin_cos();
    let at = |r: f64| f64::from(patch.sample(x + r * cos, y + r * sin));
    let level = |from: f64, to: f64| {
        (0..8)
            .map(|k| at(radius * (from + (to - from) * (f64::from(k) + 0.5) / 8.0)))
            .sum::<f64>()
            / 8.0
    };
    let (inner, outer) = (level(0.6, 0.82), level(1.2, 1.4));
    if inner - outer < 0.5 || (inner - 1.0).abs() > 0.5 || outer.abs() > 0.5 {
        return None;
    }
    let step = 0.25;
    let crossing = |share: f64| {
        let limit = outer + share * (inner - outer);
        let mut r = 0.7 * radius;
        let mut before = at(r);
        while r < 1.4 * radius {
            let here = at(r + step);
            if before >= limit && here < limit {
                return Some(r + step * (before - limit) / (before - here));
            }
            before = here;
            r += step;
        }
        None
    };
    let (near, middle, far) = (crossing(0.8)?, crossing(0.5)?, crossing(0.2)?);
    Some((middle, (far - near).max(0.0) / 1.683)) // 20 to 80 % of a normal edge are 1.683 standard deviations
}

/// Channel-wise median of the pixels between two distances of a place, 0 to 255.
fn mean_colour(picture: &RgbImage, center: Pixel, inner_px: f64, outer_px: f64) -> [f32; 3] {
    let mut channels: [Vec<u8>; 3] = Default::default();
    let range = |c: f64, size: u32| {
        let low = (c - outer_px).floor().max(0.0) as u32;
        low..((c + outer_px).ceil().max(0.0) as u32 + 1).min(size)
    };
    for v in range(center.v_px, picture.height()) {
        for u in range(center.u_px, picture.width()) {
            let r = Pixel::new(f64::from(u), f64::from(v)).distance_px(&center);
            if (inner_px..=outer_px).contains(&r) {
                for (channel, value) in channels.iter_mut().zip(picture.get_pixel(u, v).0) {
                    channel.push(value);
                }
            }
        }
    }
    channels.map(|mut values| {
        if values.is_empty() {
            return 0.0;
        }
        let middle = values.len() / 2;
        f32::from(*values.select_nth_unstable(middle).1)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::gaussian;
    use geometry::{CameraModel, DepthMap};
    use image::Rgb;

    const GREEN: [f64; 3] = [40.0, 170.0, 90.0];
    const WHITE: [f64; 3] = [225.0, 225.0, 220.0];

    /// Ellipses (centre u, v, diameter, flattening) on white; `blur_px` is the half width of a box.
    fn draw(discs: &[[f64; 4]], blur_px: f64, noise: f64, covered: impl Fn(f64, f64) -> bool) -> RgbImage {
        const SUB: u32 = 8;
        let mut random = 11;
        RgbImage::from_fn(320, 240, |x, y| {
            let mut sum = [0.0; 3];
            for k in 0..SUB * SUB {
                let spread = |i: u32| (2.0 * blur_px + 1.0) * ((f64::from(i) + 0.5) / f64::from(SUB) - 0.5);
                let (u, v) = (f64::from(x) + spread(k % SUB), f64::from(y) + spread(k / SUB));
                let disc = |d: &[f64; 4]| (u - d[0]).hypot((v - d[1]) / d[3]) < 0.5 * d[2];
                let colour = if covered(u, v) {
                    [30.0, 30.0, 35.0]
                } else if discs.iter().any(disc) {
                    GREEN
                } else {
                    WHITE
                };
                for c in 0..3 {
                    // Light falls off from left to right.
                    sum[c] += colour[c] * (1.0 - 0.3 * u / 320.0) / f64::from(SUB * SUB);
                }
            }
            Rgb(sum.map(|s| (s + noise * gaussian(&mut random)).round() as u8))
        })
    }

    #[test]
    fn the_centre_is_good_to_a_twentieth_of_a_pixel() -> Result<(), MarkerError> {
        for (k, disc) in [
            [150.0, 120.0, 70.0, 1.0],
            [141.37, 118.81, 64.3, 0.93],
            [97.62, 101.5, 30.7, 0.97],
            [200.25, 130.75, 91.0, 0.85],
        ]
        .into_iter()
        .enumerate()
        {
            let marker = find_marker(&draw(&[disc], 0.6, 2.0, |_, _| false), &MarkerSpec::default())?;
            let off = marker.pixel.distance_px(&Pixel::new(disc[0], disc[1]));
            assert!(off < 0.05, "{k}: {off} {marker:?}");
            assert!((0.005..0.05).contains(&marker.sigma_px), "{k}: {marker:?}");
            assert!((marker.axes_px[0] - disc[2]).abs() < 0.8, "{k}: {marker:?}");
            assert!((marker.axes_px[1] - disc[2] * disc[3]).abs() < 0.8, "{k}: {marker:?}");
        }
        Ok(())
    }

    #[test]
    fn every_abnormal_case_has_its_error() {
        let spec = MarkerSpec::default();
        let clear = |_: f64, _: f64| false;
        let disc = [150.0, 120.0, 70.0, 1.0];
        let find = |picture: &RgbImage| find_marker(picture, &spec).expect_err("abnormal");
        assert_eq!(find(&draw(&[], 0.6, 2.0, clear)), MarkerError::NotFound);
        assert_eq!(find(&RgbImage::new(1, 1)), MarkerError::NotFound);
        assert_eq!(find(&RgbImage::new(0, 0)), MarkerError::NotFound);
        let two = draw(&[disc, [260.0, 100.0, 60.0, 1.0]], 0.6, 2.0, clear);
        assert_eq!(find(&two), MarkerError::Several { count: 2 });
        let small = draw(&[[150.0, 120.0, 12.0, 1.0]], 0.6, 2.0, clear);
        assert!(
            matches!(find(&small), MarkerError::WrongSize { .. }),
            "{:?}",
            find(&small)
        );
        for hidden in [
            draw(&[disc], 0.6, 2.0, |u, _| u < 135.0),
            draw(&[disc], 0.6, 2.0, |u, v| (v - u + 20.0).abs() < 12.0),
            draw(&[[20.0, 120.0, 70.0, 1.0]], 0.6, 2.0, clear),
        ] {
            assert!(
                matches!(find(&hidden), MarkerError::PartlyHidden { .. }),
                "{:?}",
                find(&hidden)
            );
        }
        let blurred = draw(&[disc], 9.0, 2.0, clear);
        assert!(
            matches!(find(&blurred), MarkerError::Blurred { .. }),
            "{:?}",
            find(&blurred)
        );
    }

    #[test]
    fn depth_gives_its_place_in_space() {
        let mut frame = RgbdFrame {
            color: draw(&[[150.0, 120.0, 70.0, 1.0]], 0.6, 2.0, |_, _| false),
            depth: Some(DepthMap {
                width: 160,
                height: 120,
                step: 2,
                depth_mm: vec![1500.0; 160 * 120],
            }),
            camera: Some(CameraModel::pinhole(320, 240, 4600.0, 4600.0)),
            t_s: 0.0,
        };
        let found = locate_marker(&frame, &MarkerSpec::default()).expect("all there");
        let expected = [
            (150.0 - 159.5) * 1500.0 / 4600.0,
            (120.0 - 119.5) * 1500.0 / 4600.0,
            1500.0,
        ];
        assert!(
            found
                .point
                .distance_mm(Point::new(expected[0], expected[1], expected[2]))
                < 0.03,
            "{found:?}"
        );
        frame.depth = None;
        let error = locate_marker(&frame, &MarkerSpec::default()).expect_err("no depth");
        assert!(error.to_string().contains("no depth on the marker at (150, 120) px"));
    }
}
