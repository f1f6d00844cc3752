//! Photographed surfaces (CC0, see `data/SOURCE.md`), decoded once, read as linear RGB.

use rand::RngExt;
use std::sync::LazyLock;

/// A tile of a photographed surface.
struct Tile {
    side: usize,
    texels: Vec<[f32; 3]>,
}

/// Linear value of an 8-bit sRGB one.
fn linear(value: u8) -> f32 {
    let v = f32::from(value) / 255.0;
    if v <= 0.040_45 {
        v / 12.92
    } else {
        ((v + 0.055) / 1.055).powf(2.4)
    }
}

fn decode(bytes: &[u8]) -> image::RgbImage {
    // The bytes are part of the program, a test decodes them: a grey texel only keeps this total.
    image::load_from_memory(bytes).map_or_else(
        |_| image::RgbImage::from_pixel(1, 1, image::Rgb([128; 3])),
        |picture| picture.to_rgb8(),
    )
}

fn cut(picture: &image::RgbImage, x: u32, y: u32, side: u32) -> Tile {
    let side = side.min(picture.width()).min(picture.height());
    let view = image::imageops::crop_imm(picture, x, y, side, side).to_image();
    Tile {
        side: side as usize,
        texels: view.pixels().map(|p| p.0.map(linear)).collect(),
    }
}

static RUST: LazyLock<Vec<Tile>> = LazyLock::new(|| {
    let sheet = decode(include_bytes!("../data/rust_tiles.jpg"));
    (0..9).map(|i| cut(&sheet, 128 * (i % 3), 128 * (i / 3), 128)).collect()
});
static RUSTY: LazyLock<Vec<Tile>> =
    LazyLock::new(|| vec![cut(&decode(include_bytes!("../data/rusty_metal.jpg")), 0, 0, 512)]);
static WORN: LazyLock<Vec<Tile>> =
    LazyLock::new(|| vec![cut(&decode(include_bytes!("../data/worn_metal.jpg")), 0, 0, 256)]);

/// Which photographs to read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Surface {
    /// Closed rust, nine kinds from orange to dark brown.
    Rust,
    /// Rust breaking through a pale coating.
    RustyMetal,
    /// Weathered pale metal.
    WornMetal,
}

impl Surface {
    fn tiles(self) -> &'static [Tile] {
        match self {
            Surface::Rust => &RUST,
            Surface::RustyMetal => &RUSTY,
            Surface::WornMetal => &WORN,
        }
    }
}

/// A photographed surface laid over the plane.
#[derive(Clone, Copy)]
pub struct Texture {
    tile: &'static Tile,
    shift: [f32; 2],
    turn: [f32; 2],
}

impl Texture {
    /// One of the surface's tiles at random, `texel_mm` a texel, shifted and turned at random.
    pub fn new<R: RngExt + ?Sized>(surface: Surface, texel_mm: f32, rng: &mut R) -> Texture {
        let tiles = surface.tiles();
        let tile = &tiles[rng.random_range(0..tiles.len())];
        let angle = rng.random_range(0.0..std::f32::consts::TAU);
        let side = tile.side as f32;
        Texture {
            tile,
            shift: [rng.random_range(0.0..side), rng.random_range(0.0..side)],
            turn: [angle.cos() / texel_mm, angle.sin() / texel_mm],
        }
    }

    /// Linear RGB at a place (mm).
    #[inline]
    pub fn at(&self, x_mm: f32, y_mm: f32) -> [f32; 3] {
        let x = self.turn[0] * x_mm - self.turn[1] * y_mm + self.shift[0];
        let y = self.turn[1] * x_mm + self.turn[0] * y_mm + self.shift[1];
        // Mirrored repeat: photographs do not tile.
        let side = self.tile.side as i32;
        let fold = |v: f32| {
            let i = (v as i32).rem_euclid(2 * side);
            i.min(2 * side - 1 - i) as usize
        };
        self.tile.texels[fold(y) * self.tile.side + fold(x)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_embedded_photographs_decode() {
        assert_eq!(RUST.len(), 9);
        assert!(RUST.iter().all(|tile| tile.side == 128));
        assert_eq!(RUSTY[0].side, 512);
        assert_eq!(WORN[0].side, 256);
        let red = RUST[8].texels.iter().map(|t| t[0] - t[2]).sum::<f32>();
        assert!(red > 0.0, "rust is red");
    }
}
