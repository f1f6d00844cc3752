//! The whole of Algorithm 1: a picture in, screws out.

use std::borrow::Cow;
use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Instant;

use geometry::{Camera, CameraModel, DepthMap, Direction, Pixel, Point, RgbdFrame};
use image::RgbImage;
use nn::NnError;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::center::{Cue, CueCenter, cross, fuse, outer_circle};
use crate::coarse::{candidates, coarse_map, suppress};
use crate::fine::{Evidence, look};
use crate::layout::{CLIP_PX, Class, STRIDE};
use crate::locate::{RimProfile, facings, locate, parallax_px};
use crate::picture::{Level, pyramid_scales};
use crate::quality::{Doubt, doubts};
use crate::relief::relief;
use crate::{Model, ModelError};

/// Two finds nearer than this, in head diameters, are the same fastener.
const SAME: f64 = 0.5;
/// Below this probability of a fastener nothing that depth says makes it one.
const MAY_BE: f32 = 0.01;
/// So many candidates, screws or not, have a say in where a face looks.
const ENOUGH_HEADS: usize = 24;
/// Heads so much smaller or larger than asked for are still reported.
const HEAD_TOLERANCE: f64 = 1.5;

/// What turns a fastener.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Drive {
    /// Cross recess: Phillips, JIS, combination.
    Cross,
    /// One slot.
    Slotted,
    /// Hexagon socket.
    HexSocket,
    /// Hexalobular recess.
    Torx,
    /// Hexagon head or nut without a recess.
    HexHead,
    /// A fastener, but it cannot be told which.
    Unknown,
}

impl Drive {
    /// The name used in files.
    pub fn name(self) -> &'static str {
        match self {
            Drive::Cross => "cross",
            Drive::Slotted => "slotted",
            Drive::HexSocket => "hex_socket",
            Drive::Torx => "torx",
            Drive::HexHead => "hex_head",
            Drive::Unknown => "unknown",
        }
    }

    /// The class of the fine network that means this drive.
    pub fn class(self) -> Option<Class> {
        match self {
            Drive::Cross => Some(Class::Cross),
            Drive::Slotted => Some(Class::Slotted),
            Drive::HexSocket => Some(Class::HexSocket),
            Drive::Torx => Some(Class::Torx),
            Drive::HexHead => Some(Class::HexHead),
            Drive::Unknown => None,
        }
    }

    /// The drives that can be told apart.
    pub const KNOWN: [Drive; 5] = [
        Drive::Cross,
        Drive::Slotted,
        Drive::HexSocket,
        Drive::Torx,
        Drive::HexHead,
    ];
}

/// What may be done with a find.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// A fastener that the mounted bit fits: safe to act on.
    Screw,
    /// A fastener with another drive: reported, not acted on.
    Other,
    /// A person should look; never acted on unattended.
    Review,
}

/// A part of a picture, px.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Region {
    /// First column.
    pub u_px: u32,
    /// First row.
    pub v_px: u32,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
}

impl Region {
    /// The square of that half side around a pixel, as far as it lies in the first quadrant.
    pub fn around(pixel: Pixel, half_px: f64) -> Self {
        let low = |c: f64| (c - half_px).round().max(0.0);
        let side = |c: f64| ((c + half_px).round() - low(c)).max(0.0) as u32;
        Self {
            u_px: low(pixel.u_px) as u32,
            v_px: low(pixel.v_px) as u32,
            width_px: side(pixel.u_px),
            height_px: side(pixel.v_px),
        }
    }

    /// True if the pixel lies in it.
    pub fn contains(&self, pixel: Pixel) -> bool {
        let inside =
            |c: f64, low: u32, size: u32| c >= f64::from(low) - 0.5 && c < f64::from(low) + f64::from(size) - 0.5;
        inside(pixel.u_px, self.u_px, self.width_px) && inside(pixel.v_px, self.v_px, self.height_px)
    }
}

/// How to detect.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Head diameters to look for, px. Beyond the networks' own band (18 to 44) the picture is also searched at other scales.
    pub head_px: RangeInclusive<f64>,
    /// The bit that is mounted: what it fits is a `screw`, any other drive is `other`.
    pub bit: Drive,
    /// How much likelier than a picture alone says it is that a doubtful head has that drive: 1, or more where there is other
    /// evidence, such as a cover that does not come off.
    pub odds: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            head_px: 20.0..=40.0,
            bit: Drive::Cross,
            odds: 1.0,
        }
    }
}

/// A find.
#[derive(Clone, Debug, PartialEq)]
pub struct Screw {
    /// Centre of the recess in the plane of its rim, where a driver aims.
    pub pixel: Pixel,
    /// Standard error of the centre along each axis, px.
    pub sigma_px: f64,
    /// Diameter of the head, px.
    pub diameter_px: f64,
    /// Probability of what the verdict says (for `review`: of the mounted bit's drive).
    pub score: f64,
    /// Probability that the mounted bit fits it.
    pub fits: f64,
    /// What turns it.
    pub drive: Drive,
    /// What may be done with it.
    pub verdict: Verdict,
    /// What the centre rests on.
    pub cues: Vec<Cue>,
    /// Direction of one wing of the cross in the picture, 0 to a quarter turn, rad; where the cross was found.
    pub angle_rad: Option<f64>,
    /// Centre of the recess in space, where there is depth and a camera model.
    pub camera: Option<Point<Camera>>,
    /// Normal of the sheet around it, towards the camera: the axis of a screw that is seated straight.
    pub normal: Option<Direction<Camera>>,
    /// Normal of the head's top, towards the camera: measured apart from the sheet, on fewer points and so less exactly.
    pub top_normal: Option<Direction<Camera>>,
    /// Standard error across the optical axis, along each axis, mm.
    pub sigma_lateral_mm: Option<f64>,
    /// Standard error along the optical axis, mm.
    pub sigma_depth_mm: Option<f64>,
}

/// Time spent, ms.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// Reading the files: filled in by whoever reads them.
    pub decode: f64,
    /// Stage 1.
    pub coarse: f64,
    /// Stage 2.
    pub fine: f64,
    /// Centres.
    pub centre: f64,
    /// Depth.
    pub locate: f64,
    /// All of it.
    pub total: f64,
}

/// What was found in a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Detections {
    /// The finds: those to act on first, most probable first.
    pub screws: Vec<Screw>,
    /// Why none of them is to be acted on, and all that would be are for review; nothing where the picture can be trusted.
    pub doubts: Vec<Doubt>,
    /// Time spent.
    pub timing_ms: Timing,
    /// The model that found them.
    pub model: String,
    /// Size of the picture, px.
    pub size_px: (u32, u32),
}

/// Finds screws in pictures.
///
/// ```
/// use vision::{Detector, Options};
/// # fn main() -> Result<(), vision::ModelError> {
/// let detector = Detector::embedded()?;
/// let grey_sheet = image::RgbImage::from_pixel(200, 150, image::Rgb([120; 3]));
/// let found = detector.detect_image(&grey_sheet, &Options::default());
/// assert_eq!(found.size_px, (200, 150));
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
pub struct Detector {
    model: Model,
}

/// A find of one pyramid level, in image pixels.
struct Find {
    pixel: Pixel,
    sigma_px: f64,
    diameter_px: f64,
    evidence: Evidence,
}

/// What a find is taken for.
#[derive(Clone, Copy)]
struct Told {
    verdict: Verdict,
    drive: Drive,
    score: f64,
    fits: f64,
}

impl Detector {
    /// With a model from a file.
    ///
    /// # Errors
    /// A [`ModelError`] that names the file.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        Model::load(path).map(Self::new)
    }

    /// With a model from the bytes of its file.
    ///
    /// # Errors
    /// A [`ModelError`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, ModelError> {
        Model::from_bytes(bytes).map(Self::new)
    }

    /// With the model that ships with the program.
    ///
    /// # Errors
    /// A [`ModelError`] where the program was built with a damaged file.
    pub fn embedded() -> Result<Self, ModelError> {
        Model::embedded().map(Self::new)
    }

    /// With a model at hand.
    pub fn new(model: Model) -> Self {
        Self { model }
    }

    /// The model.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Finds the screws of a shot, and where they are in space where it has depth and a camera model.
    pub fn detect(&self, frame: &RgbdFrame, options: &Options) -> Detections {
        let (width_px, height_px) = frame.color.dimensions();
        let whole = Region {
            u_px: 0,
            v_px: 0,
            width_px,
            height_px,
        };
        self.detect_in(frame, whole, options)
    }

    /// Finds the screws of a picture without depth.
    pub fn detect_image(&self, picture: &RgbImage, options: &Options) -> Detections {
        let (width_px, height_px) = picture.dimensions();
        let whole = Region {
            u_px: 0,
            v_px: 0,
            width_px,
            height_px,
        };
        self.run(picture, whole, options, None)
    }

    /// Finds the screws whose centres lie in a part of a shot, for a second look; costs only its share.
    pub fn detect_in(&self, frame: &RgbdFrame, region: Region, options: &Options) -> Detections {
        self.run(
            &frame.color,
            region,
            options,
            frame.depth.as_ref().zip(frame.camera.as_ref()),
        )
    }

    fn run(
        &self,
        picture: &RgbImage,
        region: Region,
        options: &Options,
        space: Option<(&DepthMap, &CameraModel)>,
    ) -> Detections {
        let begin = Instant::now();
        let mut timing_ms = Timing::default();
        let mut finds = Vec::new();
        let mut doubts = doubts(picture, region, &options.head_px);
        for scale in pyramid_scales(&options.head_px) {
            if let Some(level) = self.level(picture, region, scale) {
                match self.find(&level, &mut timing_ms) {
                    Ok(found) => finds.extend(found),
                    Err(error) => doubts.push(Doubt::NotSeen {
                        reason: error.to_string(),
                    }),
                }
            }
        }
        let heads = options.head_px.start() / HEAD_TOLERANCE..=options.head_px.end() * HEAD_TOLERANCE;
        finds.retain(|f| region.contains(f.pixel) && heads.contains(&f.diameter_px));
        let finds = merge(finds);
        let start = Instant::now();
        let told: Vec<(Option<RimProfile>, Option<Told>)> = finds
            .par_iter()
            .map(|find| {
                let profile = profile(find, space);
                let rise_mm = profile.map(|profile| profile.rise_mm());
                (profile, self.tell(find, rise_mm, options))
            })
            .collect();
        // the likeliest come first
        let last = told
            .iter()
            .rposition(|(_, told)| told.is_some())
            .map_or(0, |last| last + 1);
        let around = finds.len().min(last.max(ENOUGH_HEADS));
        let mut screws: Vec<Screw> = finds[..around]
            .par_iter()
            .zip(told)
            .zip(sheet_normals(&finds[..around], space))
            .filter_map(|((find, (profile, told)), normal)| {
                let parallax_px = space.zip(normal).map_or([0.0; 2], |((_, camera), normal)| {
                    parallax_px(camera, find.pixel, normal, find.diameter_px)
                });
                let told = told?;
                let raised = space.zip(profile).filter(|_| told.verdict != Verdict::Other);
                let raised = raised
                    .and_then(|((depth, _), profile)| relief(depth, &profile.sheet, find.pixel, find.diameter_px));
                let screw = self.measure(picture, find, told, raised, parallax_px)?;
                Some(Screw { normal, ..screw })
            })
            .collect();
        if !doubts.is_empty() {
            let acted_on = screws.iter_mut().filter(|s| s.verdict == Verdict::Screw);
            acted_on.for_each(|s| s.verdict = Verdict::Review);
        }
        let rank = |s: &Screw| match s.verdict {
            Verdict::Screw => 0,
            Verdict::Review => 1,
            Verdict::Other => 2,
        };
        screws.sort_by(|a, b| rank(a).cmp(&rank(b)).then(b.score.total_cmp(&a.score)));
        timing_ms.centre = ms_since(start);
        let start = Instant::now();
        if let Some((depth, camera)) = space {
            screws.par_iter_mut().for_each(|screw| self.place(screw, depth, camera));
        }
        timing_ms.locate = ms_since(start);
        timing_ms.total = ms_since(begin);
        Detections {
            screws,
            doubts,
            timing_ms,
            model: self.model.id().to_owned(),
            size_px: picture.dimensions(),
        }
    }

    /// The region of the picture at a scale, with enough around it that the networks see the same as in the whole picture.
    fn level<'a>(&self, picture: &'a RgbImage, region: Region, scale: f64) -> Option<Level<'a>> {
        let (width, height) = picture.dimensions();
        let seen = self.model.coarse.receptive_field().unwrap_or(2 * CLIP_PX).max(CLIP_PX);
        let margin = (seen as f64 / scale).ceil() as u32;
        // Cells of the part coincide with cells of the whole where the scale is 1.
        let low = |c: u32| c.saturating_sub(margin) / STRIDE as u32 * STRIDE as u32;
        let high = |c: u32, size: u32, limit: u32| c.saturating_add(size).saturating_add(margin).min(limit);
        let (u, v) = (low(region.u_px), low(region.v_px));
        let (right, bottom) = (
            high(region.u_px, region.width_px, width),
            high(region.v_px, region.height_px, height),
        );
        if u >= right || v >= bottom || region.width_px == 0 || region.height_px == 0 {
            return None;
        }
        let part = if (u, v, right, bottom) == (0, 0, width, height) {
            Cow::Borrowed(picture)
        } else {
            Cow::Owned(image::imageops::crop_imm(picture, u, v, right - u, bottom - v).to_image())
        };
        Some(Level::new(part, Pixel::new(f64::from(u), f64::from(v)), scale))
    }

    /// Both stages on one level.
    fn find(&self, level: &Level, timing_ms: &mut Timing) -> Result<Vec<Find>, NnError> {
        let start = Instant::now();
        let map = coarse_map(&self.model.coarse, &level.picture)?;
        let places: Vec<_> = candidates(&map, &self.model.settings.thresholds)
            .iter()
            .map(|c| c.pixel)
            .collect();
        timing_ms.coarse += ms_since(start);
        let start = Instant::now();
        let evidence = look(&self.model.fine, self.model.close.as_ref(), &level.picture, &places)?;
        timing_ms.fine += ms_since(start);
        let in_image = |evidence: Evidence| Find {
            pixel: level.to_image(evidence.center),
            sigma_px: evidence.sigma_px / level.scale,
            diameter_px: evidence.diameter_px / level.scale,
            evidence,
        };
        Ok(evidence.into_iter().map(in_image).collect())
    }

    /// Verdict and drive of a find that rises so far above its sheet, where that is known; `None` where it is nothing.
    fn tell(&self, find: &Find, rise_mm: Option<f64>, options: &Options) -> Option<Told> {
        let settings = &self.model.settings;
        let probability = |drive: Drive| drive.class().map_or(0.0, |c| f64::from(find.evidence.of(c)));
        let calibrated = |p: f64| settings.corrections.probability(p, rise_mm);
        let likeliest = Drive::KNOWN
            .into_iter()
            .max_by(|a, b| probability(*a).total_cmp(&probability(*b)))?;
        let any = f64::from(find.evidence.fastener());
        let drive = if probability(likeliest) > 0.5 * any {
            likeliest
        } else {
            Drive::Unknown
        };
        let seen = calibrated(probability(options.bit));
        let fits = options.odds * seen / (options.odds * seen + 1.0 - seen);
        let t = &settings.thresholds;
        let (verdict, score) = if fits >= f64::from(t.accept) {
            (Verdict::Screw, fits)
        } else if fits >= f64::from(t.review) {
            (Verdict::Review, fits)
        } else if likeliest != options.bit && calibrated(probability(likeliest)) >= f64::from(t.other) {
            (Verdict::Other, calibrated(probability(likeliest)))
        } else if calibrated(any) >= f64::from(t.other) {
            (Verdict::Other, calibrated(any))
        } else {
            return None;
        };
        Some(Told {
            verdict,
            drive,
            score,
            fits,
        })
    }

    /// Centre of a find by all cues, `raised` the one in its depth; `None` where it has none.
    fn measure(
        &self,
        picture: &RgbImage,
        find: &Find,
        told: Told,
        raised: Option<CueCenter>,
        parallax_px: [f64; 2],
    ) -> Option<Screw> {
        let Told {
            verdict,
            drive,
            score,
            fits,
        } = told;
        let learned = CueCenter {
            pixel: find.pixel,
            sigma_px: find.sigma_px,
        };
        let circle = outer_circle(picture, find.pixel, find.diameter_px);
        let crossed = (drive == Drive::Cross || drive == Drive::Unknown)
            .then(|| cross(picture, find.pixel, find.diameter_px))
            .flatten();
        let cues = [
            Some((Cue::Learned, learned)),
            circle.map(|circle| (Cue::Circle, circle.center)),
            crossed.map(|cross| (Cue::Cross, cross.center)),
            raised.map(|raised| (Cue::Relief, raised)),
        ];
        let cues: Vec<_> = cues.into_iter().flatten().collect();
        let corrections = &self.model.settings.corrections;
        let diameter_px = circle.map_or(find.diameter_px, |circle| circle.diameter_px);
        let fused = fuse(&cues, diameter_px, parallax_px, corrections)?;
        let used = |cue| fused.cues.contains(&cue);
        Some(Screw {
            pixel: fused.center.pixel,
            sigma_px: corrections.centre_px(fused.center.sigma_px, score),
            diameter_px: circle
                .filter(|_| used(Cue::Circle))
                .map_or(find.diameter_px, |c| c.diameter_px),
            score,
            fits,
            drive,
            verdict,
            angle_rad: crossed.filter(|_| used(Cue::Cross)).map(|c| c.angle_rad),
            cues: fused.cues,
            camera: None,
            normal: None,
            top_normal: None,
            sigma_lateral_mm: None,
            sigma_depth_mm: None,
        })
    }

    /// Puts a find into space.
    fn place(&self, screw: &mut Screw, depth: &DepthMap, camera: &CameraModel) {
        let corrections = &self.model.settings.corrections;
        let found = locate(
            depth,
            camera,
            screw.pixel,
            screw.sigma_px,
            screw.diameter_px,
            corrections,
        );
        screw.camera = found.map(|f| f.point);
        screw.top_normal = found.and_then(|f| f.top_normal);
        screw.normal = screw.normal.or(found.map(|f| f.normal));
        screw.sigma_lateral_mm = found.map(|f| f.sigma_lateral_mm);
        screw.sigma_depth_mm = found.map(|f| f.sigma_depth_mm);
    }
}

/// Which way the sheet looks around each find, where there is depth. Candidates have a say in where the face looks, screw or not.
fn sheet_normals(finds: &[Find], space: Option<(&DepthMap, &CameraModel)>) -> Vec<Option<Direction<Camera>>> {
    let Some((depth, camera)) = space else {
        return vec![None; finds.len()];
    };
    let heads: Vec<(Pixel, f64)> = finds.iter().map(|f| (f.pixel, f.diameter_px)).collect();
    facings(depth, camera, &heads)
}

/// How a find rises above the sheet around it; not asked for what is surely nothing.
fn profile(find: &Find, space: Option<(&DepthMap, &CameraModel)>) -> Option<RimProfile> {
    let (depth, camera) = space.filter(|_| find.evidence.fastener() >= MAY_BE)?;
    RimProfile::of(depth, camera, find.pixel, find.diameter_px)
}

/// One find for each fastener: candidates and scales that met on the same one become the most certain of them.
fn merge(finds: Vec<Find>) -> Vec<Find> {
    suppress(
        finds,
        |f| [f.pixel.u_px, f.pixel.v_px],
        |f| f.evidence.fastener(),
        |a, b| SAME * a.diameter_px.min(b.diameter_px),
        usize::MAX,
    )
}

fn ms_since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::CLASSES;

    fn find(u: f64, diameter_px: f64, cross: f32, slotted: f32) -> Find {
        let mut probability = [0.0; CLASSES];
        probability[Class::Cross.channel()] = cross;
        probability[Class::Slotted.channel()] = slotted;
        probability[Class::Background.channel()] = 1.0 - cross - slotted;
        Find {
            pixel: Pixel::new(u, 50.0),
            sigma_px: 0.3,
            diameter_px,
            evidence: Evidence {
                center: Pixel::new(0.0, 0.0),
                sigma_px: 0.3,
                diameter_px,
                probability,
            },
        }
    }

    #[test]
    fn scales_and_candidates_merge_into_one_find_each() {
        // The same screw at two scales, its neighbour, and a small one beside a large one.
        let finds = vec![
            find(50.0, 30.0, 0.9, 0.0),
            find(52.0, 33.0, 0.7, 0.0),
            find(80.0, 30.0, 0.8, 0.0),
            find(92.0, 12.0, 0.6, 0.0),
        ];
        let kept: Vec<f64> = merge(finds).iter().map(|f| f.pixel.u_px).collect();
        assert_eq!(kept, [50.0, 80.0, 92.0]);
    }

    #[test]
    fn verdicts_follow_the_mounted_bit() -> Result<(), ModelError> {
        let detector = Detector::embedded()?;
        let mut model = detector.model().clone();
        model.settings = crate::Settings::default();
        let detector = Detector::new(model);
        let verdict = |cross, slotted, bit| {
            let options = Options {
                bit,
                ..Options::default()
            };
            detector
                .tell(&find(50.0, 30.0, cross, slotted), None, &options)
                .map(|told| (told.verdict, told.drive))
        };
        assert_eq!(verdict(0.95, 0.0, Drive::Cross), Some((Verdict::Screw, Drive::Cross)));
        assert_eq!(verdict(0.95, 0.0, Drive::Slotted), Some((Verdict::Other, Drive::Cross)));
        assert_eq!(verdict(0.05, 0.9, Drive::Cross), Some((Verdict::Other, Drive::Slotted)));
        assert_eq!(verdict(0.45, 0.1, Drive::Cross), Some((Verdict::Review, Drive::Cross)));
        assert_eq!(verdict(0.29, 0.28, Drive::Cross), Some((Verdict::Other, Drive::Cross)));
        assert_eq!(verdict(0.05, 0.1, Drive::Cross), None);
        let stuck = Options {
            odds: 150.0,
            ..Options::default()
        };
        let told = detector.tell(&find(50.0, 30.0, 0.05, 0.9), None, &stuck);
        assert_eq!(told.map(|t| t.verdict), Some(Verdict::Screw)); // a cover that stays speaks for it
        Ok(())
    }

    #[test]
    fn a_part_gives_what_the_whole_gives() -> Result<(), ModelError> {
        // Untrained or not: the coarse map of a part must be that of the whole, cell by cell.
        let detector = Detector::embedded()?;
        let picture = RgbImage::from_fn(420, 300, |x, y| {
            image::Rgb([(x * y % 251) as u8, (x % 256) as u8, (y * 3 % 256) as u8])
        });
        let region = Region {
            u_px: 171,
            v_px: 130,
            width_px: 60,
            height_px: 40,
        };
        let level = detector.level(&picture, region, 1.0).expect("inside");
        let (whole, part) = (
            coarse_map(&detector.model.coarse, &picture).expect("own kernels"),
            coarse_map(&detector.model.coarse, &level.picture).expect("own kernels"),
        );
        let corner = level.to_image(Pixel::new(0.0, 0.0));
        let (cu, cv) = (corner.u_px as usize / STRIDE, corner.v_px as usize / STRIDE);
        for v in 33..42 {
            for u in 43..57 {
                let (a, b) = (
                    whole.probability[v * whole.width + u],
                    part.probability[(v - cv) * part.width + u - cu],
                );
                assert!((a - b).abs() < 1e-6, "{u} {v}: {a} {b}");
            }
        }
        Ok(())
    }

    #[test]
    fn strange_pictures_do_not_panic() -> Result<(), ModelError> {
        let detector = Detector::embedded()?;
        let wide = Options {
            head_px: 5.0..=200.0,
            ..Options::default()
        };
        for (width, height) in [(0, 0), (1, 1), (3, 200), (64, 64)] {
            for value in [0, 255] {
                let picture = RgbImage::from_pixel(width, height, image::Rgb([value; 3]));
                for options in [&Options::default(), &wide] {
                    let found = detector.detect_image(&picture, options);
                    assert_eq!(found.size_px, (width, height));
                }
            }
        }
        Ok(())
    }
}
