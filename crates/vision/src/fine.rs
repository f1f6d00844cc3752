//! Stage 2: a clip around each candidate, its light evened out, and the mean of the high-precision networks.

use geometry::{Pixel, space};
use image::RgbImage;
use nn::{Network, Tensor, softmax};
use rayon::prelude::*;

use crate::layout::{
    CLASS_CHANNELS, CLASSES, CLIP_CENTER_PX, CLIP_PX, Class, FINE_CHANNELS, FINE_INPUT_CHANNELS, LN_DIAMETER,
    MAP_CELLS, NOMINAL_HEAD_PX, OFFSET_U, OFFSET_UNIT_PX, OFFSET_V, TRAINED_HEAD_PX, cell_center_px, network_value,
};

/// Luminance (0 to 1, sRGB) that the gamma correction gives a clip's median.
const MEDIAN_LUMA: f64 = 0.45;
/// Votes farther than this from the centre belong to something else, in head diameters.
const VOTE_RADIUS: f64 = 0.5;
/// Radius of the disc whose mean decides about the class, in head diameters.
const DECISION_RADIUS: f64 = 0.25;
/// Neighbouring cells see nearly the same pixels: so many of them count as one independent vote.
const CELLS_A_VOTE: f64 = 4.0;
/// Half side of the square in which a pixel's contrast is measured, px: about a recess.
const CONTRAST_REACH_PX: usize = 9;
/// Contrast that is as good as none (of 2): noise is not to look like a recess.
const CONTRAST_FLOOR: f32 = 0.03;
/// Clips that go through the networks at once: bounds the memory.
const BATCH: usize = 64;

/// From this probability of a fastener on, the whole ensemble looks, from all sides.
const WORTH_MORE: f32 = 0.05;
/// The clip as it is, and its mirror images: signs along u and v. The networks' errors differ between them.
const VIEWS: [[i64; 2]; 4] = [[1, 1], [-1, 1], [1, -1], [-1, -1]];

/// A square of the picture around a candidate; outside the picture its border is repeated.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// Picture pixel under clip pixel [`CLIP_CENTER_PX`].
    middle: [i64; 2],
    /// Picture pixels per clip pixel along each axis: 1, or -1 where mirrored.
    sign: [i64; 2],
    rgb: Vec<u8>,
}

impl Clip {
    /// Cuts a clip of [`CLIP_PX`] a side such that `center`, rounded, is its pixel [`CLIP_CENTER_PX`].
    pub fn cut(picture: &RgbImage, center: Pixel<space::Clip>) -> Self {
        Self::mirrored(picture, center, [1, 1])
    }

    /// As [`cut`](Self::cut), mirrored about that pixel along the axes whose sign is -1.
    fn mirrored(picture: &RgbImage, center: Pixel<space::Clip>, sign: [i64; 2]) -> Self {
        let middle = [center.u_px, center.v_px].map(|c| c.round() as i64);
        let (width, height) = (i64::from(picture.width()), i64::from(picture.height()));
        let mut rgb = Vec::with_capacity(CLIP_PX * CLIP_PX * 3);
        let raw = picture.as_raw();
        let source = |axis: usize, c: i64, size: i64| {
            (middle[axis] + sign[axis] * (c - CLIP_CENTER_PX as i64)).clamp(0, size - 1)
        };
        for y in 0..CLIP_PX as i64 {
            let v = source(1, y, height);
            for x in 0..CLIP_PX as i64 {
                let at = 3 * (v * width + source(0, x, width)) as usize;
                rgb.extend_from_slice(&raw[at..at + 3]);
            }
        }
        Self { middle, sign, rgb }
    }

    /// Where a place of the picture lies in the clip.
    fn to_clip(&self, place: Pixel<space::Clip>) -> [f64; 2] {
        let along =
            |axis: usize, c: f64| CLIP_CENTER_PX as f64 + self.sign[axis] as f64 * (c - self.middle[axis] as f64);
        [along(0, place.u_px), along(1, place.v_px)]
    }

    /// Where a place of the clip lies in the picture.
    fn to_picture(&self, place: Pixel<space::Clip>) -> Pixel<space::Clip> {
        let along =
            |axis: usize, c: f64| self.middle[axis] as f64 + self.sign[axis] as f64 * (c - CLIP_CENTER_PX as f64);
        Pixel::new(along(0, place.u_px), along(1, place.v_px))
    }

    /// The exponent that brings the clip's median luminance to 0.45, between 0.4 and 2.5.
    pub fn gamma(&self) -> f64 {
        let mut histogram = [0usize; 256];
        for pixel in self.rgb.chunks_exact(3) {
            let [r, g, b] = [pixel[0], pixel[1], pixel[2]].map(u32::from);
            histogram[((54 * r + 183 * g + 19 * b) >> 8) as usize] += 1;
        }
        let (mut below, mut median) = (0, 0);
        while below + histogram[median] <= CLIP_PX * CLIP_PX / 2 && median < 255 {
            below += histogram[median];
            median += 1;
        }
        let median = (median as f64 / 255.0).clamp(0.01, 0.99);
        (MEDIAN_LUMA.ln() / median.ln()).clamp(0.4, 2.5)
    }

    /// What the fine network sees, row by row: RGB, gamma corrected, -1 to 1, then the local contrast; `out` has [`CLIP_PX`]² x
    /// [`FINE_INPUT_CHANNELS`] values.
    pub fn network_input(&self, out: &mut [f32]) {
        let gamma = self.gamma();
        let table: [f32; 256] = std::array::from_fn(|v| {
            let corrected = 255.0 * (v as f64 / 255.0).powf(gamma);
            network_value(corrected.round() as u8)
        });
        let mut luma = Vec::with_capacity(CLIP_PX * CLIP_PX);
        for (to, from) in out.chunks_exact_mut(FINE_INPUT_CHANNELS).zip(self.rgb.chunks_exact(3)) {
            for (to, &from) in to.iter_mut().zip(from) {
                *to = table[usize::from(from)];
            }
            // as measured: the correction for a bright panel leaves nothing of a black head's recess
            let [r, g, b] = [from[0], from[1], from[2]].map(network_value);
            luma.push(0.3 * r + 0.6 * g + 0.1 * b);
        }
        let contrast = local_contrast(&luma);
        for (to, contrast) in out.chunks_exact_mut(FINE_INPUT_CHANNELS).zip(contrast) {
            to[3] = contrast;
        }
    }
}

/// How far each pixel's luminance, as measured, is from the mean of the pixels around it, in their standard deviations: a recess in a black head
/// looks as one in a bright head does.
fn local_contrast(luma: &[f32]) -> Vec<f32> {
    const SIDE: usize = CLIP_PX + 1;
    let mut sums = vec![[0f32; 2]; SIDE * SIDE]; // of luminance and its square, over all pixels above and to the left
    for y in 0..CLIP_PX {
        let mut row = [0f32; 2];
        for x in 0..CLIP_PX {
            let value = luma[y * CLIP_PX + x];
            row = [row[0] + value, row[1] + value * value];
            let above = sums[y * SIDE + x + 1];
            sums[(y + 1) * SIDE + x + 1] = [row[0] + above[0], row[1] + above[1]];
        }
    }
    let ends = |c: usize| {
        (
            c.saturating_sub(CONTRAST_REACH_PX),
            (c + CONTRAST_REACH_PX + 1).min(CLIP_PX),
        )
    };
    let pixels = (0..CLIP_PX * CLIP_PX).map(|i| (i / CLIP_PX, i % CLIP_PX));
    pixels
        .map(|(y, x)| {
            let ((top, bottom), (left, right)) = (ends(y), ends(x));
            let n = ((bottom - top) * (right - left)) as f32;
            let [mean, square] = [0, 1].map(|k| {
                let at = |y: usize, x: usize| sums[y * SIDE + x][k];
                (at(bottom, right) - at(top, right) - at(bottom, left) + at(top, left)) / n
            });
            let variance = (square - mean * mean).max(0.0);
            (luma[y * CLIP_PX + x] - mean) / (variance + CONTRAST_FLOOR * CONTRAST_FLOOR).sqrt()
        })
        .collect()
}

/// What the ensemble says about one candidate, in the pixels of the picture that it saw.
#[derive(Clone, Debug, PartialEq)]
pub struct Evidence {
    /// Voted centre of the recess.
    pub center: Pixel<space::Clip>,
    /// Spread of the votes, over cells and networks, px.
    pub sigma_px: f64,
    /// Diameter of the head, px.
    pub diameter_px: f64,
    /// Mean probability of each [`Class`] around the centre.
    pub probability: [f32; CLASSES],
}

impl Evidence {
    /// Probability of a class.
    pub fn of(&self, class: Class) -> f32 {
        self.probability[class.channel()]
    }

    /// Probability of a fastener of any drive.
    pub fn fastener(&self) -> f32 {
        Class::ALL.iter().filter(|c| c.is_fastener()).map(|&c| self.of(c)).sum()
    }
}

/// Looks at each place with the first network; where that says that there may be a fastener, the whole ensemble looks at the clip
/// around the centre that it voted for, and at the three mirror images of it, and the mean decides.
///
/// # Arguments
/// * `networks` – one network is an ensemble too.
///
/// # Returns
/// Evidence for each place, in the same order.
pub fn look(networks: &[Network], picture: &RgbImage, places: &[Pixel<space::Clip>]) -> Vec<Evidence> {
    if picture.width() == 0 || picture.height() == 0 || networks.is_empty() {
        return Vec::new();
    }
    let mut evidence = look_once(&networks[..1], picture, places, VIEWS[0]);
    let worth: Vec<usize> = (0..evidence.len())
        .filter(|&i| evidence[i].fastener() >= WORTH_MORE)
        .collect();
    let centers: Vec<_> = worth.iter().map(|&i| evidence[i].center).collect();
    let views = VIEWS.map(|sign| look_once(networks, picture, &centers, sign));
    for (k, &i) in worth.iter().enumerate() {
        // a mirror image may have settled on a neighbour
        let same = |e: &&Evidence| e.center.distance_px(&views[0][k].center) < VOTE_RADIUS * views[0][k].diameter_px;
        evidence[i] = mean(&views.iter().map(|view| &view[k]).filter(same).collect::<Vec<_>>());
    }
    evidence
}

/// What several looks at one thing say together.
fn mean(looks: &[&Evidence]) -> Evidence {
    let share = 1.0 / looks.len() as f64;
    let over = |value: &dyn Fn(&Evidence) -> f64| share * looks.iter().map(|e| value(e)).sum::<f64>();
    let center = Pixel::new(over(&|e| e.center.u_px), over(&|e| e.center.v_px));
    let spread = over(&|e| 0.5 * e.center.distance_px(&center).powi(2));
    Evidence {
        center,
        sigma_px: (share * (over(&|e| e.sigma_px.powi(2)) + spread)).sqrt(),
        diameter_px: over(&|e| e.diameter_px.ln()).exp(),
        probability: std::array::from_fn(|c| over(&|e| f64::from(e.probability[c])) as f32),
    }
}

fn look_once(networks: &[Network], picture: &RgbImage, places: &[Pixel<space::Clip>], sign: [i64; 2]) -> Vec<Evidence> {
    let mut evidence = Vec::with_capacity(places.len());
    for places in places.chunks(BATCH) {
        let clips: Vec<Clip> = places.iter().map(|&p| Clip::mirrored(picture, p, sign)).collect();
        let mut batch = Tensor::zeros(clips.len(), CLIP_PX, CLIP_PX, FINE_INPUT_CHANNELS);
        batch
            .data
            .par_chunks_mut(CLIP_PX * CLIP_PX * FINE_INPUT_CHANNELS)
            .zip(&clips)
            .for_each(|(out, clip)| clip.network_input(out));
        let maps: Vec<Tensor> = networks
            .iter()
            .map(|network| {
                let mut map = network.forward_batch(&batch);
                softmax(&mut map, CLASS_CHANNELS);
                map
            })
            .collect();
        evidence.par_extend(clips.par_iter().zip(places).enumerate().map(|(n, (clip, &place))| {
            let maps: Vec<&[f32]> = maps
                .iter()
                .map(|map| &map.data[map.index(n, 0, 0)..][..MAP_CELLS * MAP_CELLS * FINE_CHANNELS])
                .collect();
            let evidence = judge(&maps, clip.to_clip(place));
            Evidence {
                center: clip.to_picture(evidence.center),
                ..evidence
            }
        }));
    }
    evidence
}

/// One cell's opinion about where the centre is, clip px.
struct Vote {
    at: [f64; 2],
    ln_diameter: f64,
    weight: f64,
}

/// Turns the networks' maps (probabilities, then regressions) of one clip into evidence; `start` is the candidate, clip px.
fn judge(maps: &[&[f32]], start: [f64; 2]) -> Evidence {
    let networks = maps.len().max(1) as f64;
    let mut mean = vec![0f32; MAP_CELLS * MAP_CELLS * FINE_CHANNELS];
    for map in maps {
        for (sum, value) in mean.iter_mut().zip(*map) {
            *sum += value / networks as f32;
        }
    }
    let votes = votes(&mean);
    let (center, diameter_px) = agree(&votes, start);
    let reach = VOTE_RADIUS * diameter_px;
    let (cells, effective) = spread(&votes, center, reach);
    let apart: f64 = maps
        .iter()
        .map(|map| {
            let own = average(&self::votes(map), center, reach).map_or(center, |(c, _)| c);
            (own[0] - center[0]).powi(2) + (own[1] - center[1]).powi(2)
        })
        .sum::<f64>()
        / (2.0 * networks);
    Evidence {
        center: Pixel::new(center[0], center[1]),
        sigma_px: (cells * CELLS_A_VOTE / effective.max(1.0) + apart + 0.01).sqrt(),
        diameter_px,
        probability: class_means(&mean, center, DECISION_RADIUS * diameter_px),
    }
}

fn votes(map: &[f32]) -> Vec<Vote> {
    let cells = map.chunks_exact(FINE_CHANNELS).enumerate();
    cells
        .map(|(i, cell)| Vote {
            at: [
                cell_center_px(i % MAP_CELLS) + OFFSET_UNIT_PX * f64::from(cell[OFFSET_U]),
                cell_center_px(i / MAP_CELLS) + OFFSET_UNIT_PX * f64::from(cell[OFFSET_V]),
            ],
            ln_diameter: f64::from(cell[LN_DIAMETER]),
            weight: f64::from(1.0 - cell[Class::Background.channel()]),
        })
        .filter(|vote| vote.weight > 0.02 && vote.at.iter().all(|c| c.is_finite()))
        .collect()
}

/// The place near `start` on which most votes agree (mean shift), and the diameter there.
fn agree(votes: &[Vote], start: [f64; 2]) -> ([f64; 2], f64) {
    let mut center = start;
    let mut diameter_px = NOMINAL_HEAD_PX;
    // The first reach takes in a whole head on which the candidate lies off the middle.
    let mut reach = 0.5 * TRAINED_HEAD_PX.end();
    for _ in 0..8 {
        let Some((mean, ln_diameter)) = average(votes, center, reach) else {
            break;
        };
        let moved = (mean[0] - center[0]).hypot(mean[1] - center[1]);
        center = mean;
        diameter_px = NOMINAL_HEAD_PX * ln_diameter.clamp(-1.2, 1.2).exp();
        let narrow = VOTE_RADIUS * diameter_px;
        if moved < 0.01 && reach <= narrow {
            break;
        }
        reach = narrow.min(reach);
    }
    (center, diameter_px)
}

/// Weighted mean of the votes within `reach` of `center`: place and ln diameter.
fn average(votes: &[Vote], center: [f64; 2], reach: f64) -> Option<([f64; 2], f64)> {
    let (mut u, mut v, mut ln_diameter, mut sum) = (0.0, 0.0, 0.0, 0.0);
    for (vote, weight) in near(votes, center, reach) {
        u += weight * vote.at[0];
        v += weight * vote.at[1];
        ln_diameter += weight * vote.ln_diameter;
        sum += weight;
    }
    (sum > 0.0).then(|| ([u / sum, v / sum], ln_diameter / sum))
}

/// Variance of the votes along one axis, px², and how many they count as.
fn spread(votes: &[Vote], center: [f64; 2], reach: f64) -> (f64, f64) {
    let (mut square, mut sum, mut sum_square) = (0.0, 0.0, 0.0);
    for (vote, weight) in near(votes, center, reach) {
        square += weight * ((vote.at[0] - center[0]).powi(2) + (vote.at[1] - center[1]).powi(2));
        sum += weight;
        sum_square += weight * weight;
    }
    if sum > 0.0 {
        (0.5 * square / sum, sum * sum / sum_square)
    } else {
        (0.25 * reach * reach, 1.0)
    }
}

/// Votes within `reach`, weighted so that those at its border do not jump in and out (biweight).
fn near(votes: &[Vote], center: [f64; 2], reach: f64) -> impl Iterator<Item = (&Vote, f64)> {
    votes.iter().filter_map(move |vote| {
        let r2 = ((vote.at[0] - center[0]).powi(2) + (vote.at[1] - center[1]).powi(2)) / (reach * reach);
        (r2 < 1.0).then(|| (vote, vote.weight * (1.0 - r2).powi(2)))
    })
}

/// Mean class probabilities over the cells within `radius` of the centre, the four around it always included.
fn class_means(map: &[f32], center: [f64; 2], radius: f64) -> [f32; CLASSES] {
    let mut mean = [0f32; CLASSES];
    let mut sum = 0.0;
    let radius = radius.max(0.75 * cell_center_px(1));
    for (i, cell) in map.chunks_exact(FINE_CHANNELS).enumerate() {
        let off = (cell_center_px(i % MAP_CELLS) - center[0]).hypot(cell_center_px(i / MAP_CELLS) - center[1]);
        // Cells fade out over one cell's width: the mean changes smoothly with the centre.
        let weight = ((radius - off) / cell_center_px(1) + 0.5).clamp(0.0, 1.0) as f32;
        if weight > 0.0 {
            for (m, p) in mean.iter_mut().zip(cell) {
                *m += weight * p;
            }
            sum += weight;
        }
    }
    if sum > 0.0 {
        mean.iter_mut().for_each(|m| *m /= sum);
    } else {
        mean[Class::Background.channel()] = 1.0; // the votes left the clip
    }
    mean
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A map as a perfect network would give it for a cross screw at `at` (clip px).
    fn ideal(at: [f64; 2], diameter_px: f64, shift: f64) -> Vec<f32> {
        let mut map = vec![0f32; MAP_CELLS * MAP_CELLS * FINE_CHANNELS];
        for (i, cell) in map.chunks_exact_mut(FINE_CHANNELS).enumerate() {
            let [u, v] = [cell_center_px(i % MAP_CELLS), cell_center_px(i / MAP_CELLS)];
            let inside = (u - at[0]).hypot(v - at[1]) < 0.28 * diameter_px;
            cell[Class::Cross.channel()] = if inside { 0.97 } else { 0.0 };
            cell[Class::Background.channel()] = if inside { 0.03 } else { 1.0 };
            cell[OFFSET_U] = ((at[0] + shift - u) / OFFSET_UNIT_PX) as f32;
            cell[OFFSET_V] = ((at[1] - u * 0.0 - v) / OFFSET_UNIT_PX) as f32;
            cell[LN_DIAMETER] = (diameter_px / NOMINAL_HEAD_PX).ln() as f32;
        }
        map
    }

    #[test]
    fn votes_of_the_ensemble_give_centre_class_and_spread() {
        for diameter in [18.0, 30.0, 44.0] {
            let maps = [-0.3, 0.0, 0.3].map(|shift| ideal([35.3, 27.8], diameter, shift));
            let maps: Vec<&[f32]> = maps.iter().map(Vec::as_slice).collect();
            let evidence = judge(&maps, [32.0, 32.0]);
            let off = evidence.center.distance_px(&Pixel::new(35.3, 27.8));
            assert!(off < 0.05, "{diameter}: {evidence:?}");
            assert!((evidence.diameter_px - diameter).abs() < 0.1);
            assert!(evidence.of(Class::Cross) > 0.85, "{diameter}: {evidence:?}");
            assert!((0.15..0.4).contains(&evidence.sigma_px), "{evidence:?}"); // half of 0.3² * 2 / 3, and a floor
        }
    }

    #[test]
    fn the_nearer_of_two_screws_is_the_one_described() {
        let (near, far) = (ideal([30.0, 32.0], 20.0, 0.0), ideal([54.0, 34.0], 20.0, 0.0));
        let both: Vec<f32> = near
            .chunks_exact(FINE_CHANNELS)
            .zip(far.chunks_exact(FINE_CHANNELS))
            .flat_map(|(a, b)| if b[1] > a[1] { b } else { a }.to_vec())
            .collect();
        let evidence = judge(&[&both], [32.0, 32.0]);
        assert!(
            evidence.center.distance_px(&Pixel::new(30.0, 32.0)) < 0.1,
            "{evidence:?}"
        );
    }

    #[test]
    fn a_mirrored_clip_shows_the_same_place() {
        let picture = RgbImage::from_fn(120, 100, |x, y| image::Rgb([x as u8, y as u8, 0]));
        let center = Pixel::new(61.4, 47.8);
        for sign in [[1, 1], [-1, 1], [1, -1], [-1, -1]] {
            let clip = Clip::mirrored(&picture, center, sign);
            let at = clip.to_clip(center);
            assert!((at[0] - 32.0).hypot(at[1] - 32.0) < 0.75);
            assert!(clip.to_picture(Pixel::new(at[0], at[1])).distance_px(&center) < 1e-9);
            for (x, y) in [(3, 5), (32, 32), (60, 11)] {
                let there = clip.to_picture(Pixel::new(f64::from(x), f64::from(y)));
                let at = 3 * (y as usize * CLIP_PX + x as usize);
                assert_eq!([clip.rgb[at], clip.rgb[at + 1]], [there.u_px as u8, there.v_px as u8]);
            }
        }
    }

    #[test]
    fn nothing_there_is_background() {
        let mut nothing = vec![0f32; MAP_CELLS * MAP_CELLS * FINE_CHANNELS];
        nothing.chunks_exact_mut(FINE_CHANNELS).for_each(|cell| cell[0] = 1.0);
        let evidence = judge(&[&nothing], [32.0, 32.0]);
        assert!(evidence.of(Class::Background) > 0.99 && evidence.fastener() < 0.01);
    }

    #[test]
    fn gamma_evens_out_dark_and_bright_clips() {
        let at = Pixel::new(40.0, 40.0);
        for (value, expected) in [(30u8, 0.4), (115, 1.0), (190, 2.5)] {
            let picture = RgbImage::from_pixel(80, 80, image::Rgb([value; 3]));
            let gamma = Clip::cut(&picture, at).gamma();
            assert!((gamma - expected).abs() < 0.05, "{value}: {gamma}");
        }
        let mut input = vec![0f32; CLIP_PX * CLIP_PX * FINE_INPUT_CHANNELS];
        Clip::cut(&RgbImage::from_pixel(80, 80, image::Rgb([60; 3])), at).network_input(&mut input);
        for pixel in input.chunks_exact(FINE_INPUT_CHANNELS) {
            assert!(
                pixel[..3].iter().all(|v| (v - (2.0 * 0.45 - 1.0)).abs() < 0.05) && pixel[3].abs() < 1e-3,
                "{pixel:?}"
            );
        }
    }

    #[test]
    fn the_recess_of_a_black_head_is_seen_as_that_of_a_bright_one() {
        // a bright panel, a head with a ring as recess, four levels or forty darker than the head
        let contrast = |head: u8, recess: u8| {
            let picture = RgbImage::from_fn(80, 80, |x, y| {
                let r = (f64::from(x) - 40.0).hypot(f64::from(y) - 40.0);
                image::Rgb(
                    [if r > 24.0 {
                        210
                    } else if (4.0..7.0).contains(&r) {
                        recess
                    } else {
                        head
                    }; 3],
                )
            });
            let mut input = vec![0f32; CLIP_PX * CLIP_PX * FINE_INPUT_CHANNELS];
            Clip::cut(&picture, Pixel::new(40.0, 40.0)).network_input(&mut input);
            let at = |x: usize| input[(CLIP_CENTER_PX * CLIP_PX + x) * FINE_INPUT_CHANNELS + 3];
            at(CLIP_CENTER_PX) - at(CLIP_CENTER_PX + 5)
        };
        let (bright, black, none) = (contrast(160, 120), contrast(20, 14), contrast(20, 20));
        assert!(
            bright > 1.5 && black > 0.4 * bright && none.abs() < 0.01,
            "{bright} {black} {none}"
        );
    }
}
