//! Stage 2: a clip around each candidate, its light evened out, and the mean of the high-precision networks.

use geometry::{Pixel, space};
use image::RgbImage;
use nn::{Engine, NnError, Tensor, softmax};
use rayon::prelude::*;

use crate::clip::Clip;
use crate::layout::{
    CLASS_CHANNELS, CLASSES, CLIP_PX, CLOSE_HEAD_PX, Class, FINE_CHANNELS, FINE_INPUT_CHANNELS, LN_DIAMETER, MAP_CELLS,
    NOMINAL_HEAD_PX, OFFSET_U, OFFSET_UNIT_PX, OFFSET_V, TRAINED_HEAD_PX, cell_center_px,
};

/// Votes farther than this from the centre belong to something else, in head diameters.
const VOTE_RADIUS: f64 = 0.5;
/// Radius of the disc whose mean decides about the class, in head diameters.
const DECISION_RADIUS: f64 = 0.25;
/// Neighbouring cells see nearly the same pixels: so many of them count as one independent vote.
const CELLS_A_VOTE: f64 = 4.0;
/// Clips that go through the networks at once: bounds the memory.
const BATCH: usize = 64;

/// From this probability of a fastener on, there are more looks than the first.
const WORTH_MORE: f32 = 0.05;
/// The clip as it is, and its mirror images: signs along u and v. The networks' errors differ between them.
const VIEWS: [[i64; 2]; 4] = [[1, 1], [-1, 1], [1, -1], [-1, -1]];
/// Views of the clip as it is, before the closer ones.
const FAR_LOOKS: usize = 2;

/// What the ensemble says about one candidate, in the pixels of the picture that it saw.
#[derive(Clone, Debug, PartialEq)]
pub struct Evidence {
    /// Voted centre of the recess.
    pub center: Pixel<space::Clip>,
    /// Spread of the votes, over cells and networks, px.
    pub sigma_px: f64,
    /// Diameter of the head, px.
    pub diameter_px: f64,
    /// Probability of each [`Class`]: mean over the networks, then geometric mean over the cells around the centre and the views.
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

/// Looks at each place with the first of the fine networks. Where that says that there may be a fastener, all of them look at the clip
/// around the centre that it voted for, from two sides, then the network that looks closer, from four sides, at clips around the mean centre so
/// far with the head [`CLOSE_HEAD_PX`] wide, as long as the mean still says so; the mean decides. Without such a network the fine ones look from all sides.
///
/// # Arguments
/// * `fine` – one network is an ensemble too.
///
/// # Returns
/// Evidence for each place, in the same order.
///
/// # Errors
/// [`NnError`] where an engine from outside fails; the own one does not.
pub fn look(
    fine: &[Engine],
    close: Option<&Engine>,
    picture: &RgbImage,
    places: &[Pixel<space::Clip>],
) -> Result<Vec<Evidence>, NnError> {
    if picture.width() == 0 || picture.height() == 0 || fine.is_empty() {
        return Ok(Vec::new());
    }
    let as_it_is = |center| Place { center, scale: None };
    let first: Vec<_> = places.iter().map(|&center| as_it_is(center)).collect();
    let mut evidence = look_once(&fine[..1], picture, &first, VIEWS[0])?;
    let mut worth: Vec<usize> = (0..evidence.len())
        .filter(|&i| evidence[i].fastener() >= WORTH_MORE)
        .collect();
    let mut looks: Vec<Vec<Evidence>> = vec![Vec::new(); evidence.len()];
    let centers: Vec<_> = evidence.iter().map(|e| e.center).collect();
    let far = if close.is_some() { FAR_LOOKS } else { VIEWS.len() };
    let far = VIEWS[..far].iter().map(|&sign| (fine, false, sign));
    let close = close.map(std::slice::from_ref).into_iter();
    let close = close.flat_map(|network| VIEWS.map(|sign| (network, true, sign)));
    for (networks, closer, sign) in far.chain(close) {
        let place = |i: usize| match closer {
            true => Place {
                center: evidence[i].center,
                scale: Some(CLOSE_HEAD_PX / evidence[i].diameter_px),
            },
            false => as_it_is(centers[i]),
        };
        let places: Vec<_> = worth.iter().map(|&i| place(i)).collect();
        for (&i, look) in worth.iter().zip(look_once(networks, picture, &places, sign)?) {
            looks[i].push(look);
            // a mirror image may have settled on a neighbour
            let first = &looks[i][0];
            let same = |e: &&Evidence| e.center.distance_px(&first.center) < VOTE_RADIUS * first.diameter_px;
            evidence[i] = mean(&looks[i].iter().filter(same).collect::<Vec<_>>());
        }
        // most of what a first look takes for a fastener off the middle is none once it is in the middle
        worth.retain(|&i| evidence[i].fastener() >= WORTH_MORE);
    }
    Ok(evidence)
}

/// Where a clip is cut: around a centre, pixel by pixel, or enlarged.
#[derive(Clone, Copy)]
struct Place {
    center: Pixel<space::Clip>,
    scale: Option<f64>,
}

impl Place {
    fn clip(&self, picture: &RgbImage, sign: [i64; 2]) -> Clip {
        match self.scale {
            Some(scale) => Clip::enlarged(picture, self.center, scale, sign),
            None => Clip::mirrored(picture, self.center, sign),
        }
    }
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
        probability: normalized(std::array::from_fn(|c| {
            over(&|e| f64::from(ln(e.probability[c]))) as f32
        })),
    }
}

/// Logarithm of a probability, bounded: one cell that is sure of the contrary does not decide alone.
fn ln(probability: f32) -> f32 {
    probability.max(1e-6).ln()
}

/// Probabilities from their logarithms up to a constant.
fn normalized(ln: [f32; CLASSES]) -> [f32; CLASSES] {
    let high = ln.iter().copied().fold(f32::MIN, f32::max);
    let odds = ln.map(|l| (l - high).exp());
    let sum: f32 = odds.iter().sum();
    odds.map(|o| o / sum)
}

fn look_once(
    networks: &[Engine],
    picture: &RgbImage,
    places: &[Place],
    sign: [i64; 2],
) -> Result<Vec<Evidence>, NnError> {
    let mut evidence = Vec::with_capacity(places.len());
    for places in places.chunks(BATCH) {
        let clips: Vec<Clip> = places.iter().map(|place| place.clip(picture, sign)).collect();
        let mut batch = Tensor::zeros(clips.len(), CLIP_PX, CLIP_PX, FINE_INPUT_CHANNELS);
        batch
            .data
            .par_chunks_mut(CLIP_PX * CLIP_PX * FINE_INPUT_CHANNELS)
            .zip(&clips)
            .for_each(|(out, clip)| clip.network_input(out));
        let maps: Vec<Tensor> = networks
            .iter()
            .map(|network| {
                let mut map = network.forward_batch(&batch)?;
                softmax(&mut map, CLASS_CHANNELS);
                Ok(map)
            })
            .collect::<Result<_, NnError>>()?;
        evidence.par_extend(clips.par_iter().zip(places).enumerate().map(|(n, (clip, place))| {
            let maps: Vec<&[f32]> = maps
                .iter()
                .map(|map| &map.data[map.index(n, 0, 0)..][..MAP_CELLS * MAP_CELLS * FINE_CHANNELS])
                .collect();
            let evidence = judge(&maps, clip.to_clip(place.center));
            let scale = place.scale.unwrap_or(1.0);
            Evidence {
                center: clip.to_picture(evidence.center),
                sigma_px: evidence.sigma_px / scale,
                diameter_px: evidence.diameter_px / scale,
                ..evidence
            }
        }));
    }
    Ok(evidence)
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

/// Geometric mean of the classes' probabilities over the cells within `radius` of the centre, the four around it always included.
fn class_means(map: &[f32], center: [f64; 2], radius: f64) -> [f32; CLASSES] {
    let mut logs = [0f32; CLASSES];
    let mut sum = 0.0;
    let radius = radius.max(0.75 * cell_center_px(1));
    for (i, cell) in map.chunks_exact(FINE_CHANNELS).enumerate() {
        let off = (cell_center_px(i % MAP_CELLS) - center[0]).hypot(cell_center_px(i / MAP_CELLS) - center[1]);
        // Cells fade out over one cell's width: the mean changes smoothly with the centre.
        let weight = ((radius - off) / cell_center_px(1) + 0.5).clamp(0.0, 1.0) as f32;
        if weight > 0.0 {
            for (log, p) in logs.iter_mut().zip(cell) {
                *log += weight * ln(*p);
            }
            sum += weight;
        }
    }
    if sum == 0.0 {
        // the votes left the clip
        return std::array::from_fn(|c| f32::from(u8::from(c == Class::Background.channel())));
    }
    normalized(logs.map(|log| log / sum))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A map as a perfect network would give it for a cross screw at `at` (clip px).
    fn ideal(at: [f64; 2], diameter_px: f64, shift: f64) -> Vec<f32> {
        let mut map = vec![0f32; MAP_CELLS * MAP_CELLS * FINE_CHANNELS];
        for (i, cell) in map.chunks_exact_mut(FINE_CHANNELS).enumerate() {
            let [u, v] = [cell_center_px(i % MAP_CELLS), cell_center_px(i / MAP_CELLS)];
            // what is not told where the item ends goes on a little beyond the labelled disc
            let inside = (u - at[0]).hypot(v - at[1]) < 0.4 * diameter_px;
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
    fn a_closer_look_speaks_of_the_same_pixels() {
        let model = crate::Model::embedded().expect("the built-in model");
        let close = model.close.as_ref().expect("it looks closer");
        for (k, diameter_px) in [22.0, 28.0, 38.0].into_iter().enumerate() {
            let screw = crate::synthetic::Screw {
                at: Pixel::new(80.3, 71.8),
                diameter_px,
                noise: 0.02,
                seed: k as u64,
                ..Default::default()
            };
            let picture = crate::synthetic::draw(160, 150, &[screw]);
            let place = Place {
                center: Pixel::new(81.0, 71.0),
                scale: Some(CLOSE_HEAD_PX / diameter_px),
            };
            for sign in VIEWS {
                let seen = &look_once(std::slice::from_ref(close), &picture, &[place], sign).expect("own kernels")[0];
                let off_px = seen.center.distance_px(&Pixel::new(80.3, 71.8));
                assert!(off_px < 0.06 * diameter_px, "{diameter_px} {sign:?}: off by {off_px}");
                assert!(
                    (seen.diameter_px / diameter_px - 1.0).abs() < 0.2,
                    "{diameter_px}: {seen:?}"
                );
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
}
