//! Random draws that depend on names and counters only, never on the order in which things happen to be asked.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// A generator for one purpose: the same seed and purpose give the same numbers, whatever was drawn for other purposes.
pub(crate) fn draw(seed: u64, purpose: &[u64]) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(mix(seed, purpose))
}

/// One seed from a seed and a purpose (SplitMix64 finaliser).
pub(crate) fn mix(seed: u64, purpose: &[u64]) -> u64 {
    purpose.iter().fold(finalise(seed), |h, p| {
        finalise(h ^ p.wrapping_mul(0x9E37_79B9_7F4A_7C15))
    })
}

fn finalise(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A number for a name, the same on every machine (FNV-1a).
pub(crate) fn name_number(name: &str) -> u64 {
    name.bytes().fold(0xCBF2_9CE4_8422_2325, |h, b| {
        (h ^ u64::from(b)).wrapping_mul(0x0000_0100_0000_01B3)
    })
}

/// A standard normal draw (Box-Muller).
pub(crate) fn normal(rng: &mut Pcg64Mcg) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    let v: f64 = rng.random();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// A draw between -1 and 1.
pub(crate) fn signed(rng: &mut Pcg64Mcg) -> f64 {
    2.0 * rng.random::<f64>() - 1.0
}
