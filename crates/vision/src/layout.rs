//! What the networks see and what their outputs mean: the one place that training and detection share.
//!
//! All networks answer at every fourth pixel: output cell `i` speaks of input pixel `4 * i` (they halve once more and enlarge
//! at their end; they have learned the half cell by which that is off).
//!
//! | network | input | output channels |
//! |---|---|---|
//! | coarse | a whole picture, RGB, [`network_value`] | 2 logits: background, something that may be a fastener's head |
//! | fine | a clip of 64 x 64 pixels, RGB gamma corrected and local contrast ([`crate::Clip::network_input`]) | 7 logits ([`Class`]), then du, dv, ln diameter |
//! | close | as fine, enlarged or shrunk until the head is [`CLOSE_HEAD_PX`] wide | as fine |

use std::ops::{Range, RangeInclusive};

use nn::{LayerSpec, Spec, Step};
use serde::{Deserialize, Serialize};

/// Head diameters, px, that the networks are trained for.
pub const TRAINED_HEAD_PX: RangeInclusive<f64> = 18.0..=44.0;
/// Head diameter, px, in the middle of that band.
pub const NOMINAL_HEAD_PX: f64 = 28.0;

/// Head diameter, px, to which a clip is enlarged or shrunk for a closer look: larger than most heads are in a picture.
pub const CLOSE_HEAD_PX: f64 = 40.0;

/// Input pixels per output cell along each axis, of all networks.
pub const STRIDE: usize = 4;

/// Output channels of the coarse network.
pub const COARSE_CHANNELS: usize = 2;
/// Coarse channel of "something that may be a fastener's head" (0 is background).
pub const COARSE_FASTENER: usize = 1;

/// Side of the fine network's clip, px.
pub const CLIP_PX: usize = 64;
/// Clip pixel (both axes) on which a candidate lies: the centre of cell 8.
pub const CLIP_CENTER_PX: usize = 32;
/// Cells along a side of the fine network's output.
pub const MAP_CELLS: usize = CLIP_PX / STRIDE;

/// Input channels of the fine network: gamma corrected red, green, blue, and the contrast around each pixel.
pub const FINE_INPUT_CHANNELS: usize = 4;

/// What the networks' inputs mean in eight bits: colour as in the picture, and contrast up to so many standard deviations.
pub const COARSE_INPUT: [Step; 3] = [Step::between(-1.0, 1.0); 3];
/// As [`COARSE_INPUT`], for the fine network.
pub const FINE_INPUT: [Step; FINE_INPUT_CHANNELS] = {
    let color = Step::between(-1.0, 1.0);
    [color, color, color, Step::between(-4.0, 4.0)]
};

/// Number of classes.
pub const CLASSES: usize = 7;
/// Fine channels that hold the class logits.
pub const CLASS_CHANNELS: Range<usize> = 0..CLASSES;
/// Fine channel of the offset along u from the cell's centre to the recess centre, in [`OFFSET_UNIT_PX`].
pub const OFFSET_U: usize = 7;
/// Fine channel of the offset along v, in [`OFFSET_UNIT_PX`].
pub const OFFSET_V: usize = 8;
/// Fine channel of ln(head diameter / [`NOMINAL_HEAD_PX`]).
pub const LN_DIAMETER: usize = 9;
/// Output channels of the fine network.
pub const FINE_CHANNELS: usize = 10;
/// Unit of the offset channels, px.
pub const OFFSET_UNIT_PX: f64 = 16.0;

/// Radius, in head diameters, of the disc of cells around a centre that carry its class.
pub const LABEL_RADIUS: f64 = 0.28;
/// Between [`LABEL_RADIUS`] and this, in head diameters, a cell is neither the item nor background: training ignores it.
pub const IGNORE_RADIUS: f64 = 0.5;

/// What a cell of the fine network shows; the value is its channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Class {
    /// Nothing of interest.
    Background = 0,
    /// A screw with a cross recess.
    Cross = 1,
    /// A screw with one slot.
    Slotted = 2,
    /// A screw with a hexagon socket.
    HexSocket = 3,
    /// A screw with a hexalobular recess.
    Torx = 4,
    /// A hexagon head or nut without a recess.
    HexHead = 5,
    /// Something round that is no fastener to turn: hole, rivet, cap, mark, dimple.
    OtherFeature = 6,
}

impl Class {
    /// Every class, in the order of the channels.
    pub const ALL: [Class; CLASSES] = [
        Class::Background,
        Class::Cross,
        Class::Slotted,
        Class::HexSocket,
        Class::Torx,
        Class::HexHead,
        Class::OtherFeature,
    ];

    /// Its channel in the fine network's output.
    pub fn channel(self) -> usize {
        self as usize
    }

    /// True for a fastener of any drive.
    pub fn is_fastener(self) -> bool {
        !matches!(self, Class::Background | Class::OtherFeature)
    }
}

/// A colour value as the networks see it: -1 (black) to 1 (white).
#[inline]
pub fn network_value(value: u8) -> f32 {
    f32::from(value) * (2.0 / 255.0) - 1.0
}

/// Input pixel on which output cell `i` is centred.
#[inline]
pub fn cell_center_px(i: usize) -> f64 {
    (i * STRIDE) as f64
}

/// The coarse network unless a model file says otherwise: sees 89 x 89 pixels, most of its layers an eighth of the picture's size;
/// 26 GFLOP for 12 megapixels.
pub fn coarse_spec() -> Spec {
    let conv = LayerSpec::conv;
    Spec {
        input_channels: 3,
        layers: vec![
            conv(5, 2, 1, 16),
            conv(3, 2, 1, 24),
            conv(3, 2, 1, 32),
            conv(3, 1, 1, 32),
            conv(3, 1, 1, 32),
            conv(3, 1, 2, 32),
            LayerSpec::Upsample2,
            LayerSpec::output(COARSE_CHANNELS),
        ],
    }
}

/// Each of the fine networks unless a model file says otherwise: a cell sees 91 x 91 pixels, the whole clip from its middle.
pub fn fine_spec() -> Spec {
    let conv = LayerSpec::conv;
    Spec {
        input_channels: FINE_INPUT_CHANNELS,
        layers: vec![
            conv(3, 2, 1, 32),
            conv(3, 1, 1, 32),
            conv(3, 2, 1, 64),
            conv(3, 1, 1, 64),
            conv(3, 1, 1, 64),
            conv(3, 2, 1, 128),
            conv(3, 1, 1, 128),
            conv(3, 1, 1, 128),
            conv(3, 1, 1, 128),
            LayerSpec::Upsample2,
            LayerSpec::output(FINE_CHANNELS),
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_networks_are_what_the_layout_says() {
        let (coarse, fine) = (coarse_spec(), fine_spec());
        coarse.check().expect("coarse spec");
        fine.check().expect("fine spec");
        assert_eq!((coarse.stride(), fine.stride()), (STRIDE, STRIDE));
        assert_eq!((coarse.pixel_map(), fine.pixel_map()), ((4.0, -2.0), (4.0, -2.0)));
        assert_eq!(fine.output_size(CLIP_PX, CLIP_PX), (MAP_CELLS, MAP_CELLS));
        assert_eq!(coarse.output_channels(), COARSE_CHANNELS);
        assert_eq!(fine.output_channels(), FINE_CHANNELS);
        assert_eq!((coarse.receptive_field(), fine.receptive_field()), (89, 91));
        assert!(coarse.flops(3006, 4104) < 27_000_000_000);
        assert_eq!(cell_center_px(8), CLIP_CENTER_PX as f64);
        assert_eq!(Class::ALL.map(Class::channel), [0, 1, 2, 3, 4, 5, 6]);
    }
}
