//! Printed labels: text, lines, bar codes and signs, as small pictures in two inks.

use rand::RngExt;

/// Dots per millimetre of a label.
const DOTS: f32 = 5.0;

/// A printed label, mm from its middle, x right, y down.
#[derive(Clone, Debug)]
pub(crate) struct Print {
    width: usize,
    height: usize,
    /// Index into `inks`, row by row; 0 is the ground.
    dots: Vec<u8>,
    /// Linear RGB and cover of the ground and of every ink.
    inks: Vec<([f32; 3], f32)>,
}

/// Five columns of seven dots each, lowest bit on top, for the characters from space to Z.
#[rustfmt::skip]
const FONT: [[u8; 5]; 59] = [
    [0,0,0,0,0],[0,0,0x5F,0,0],[0,7,0,7,0],[0x14,0x7F,0x14,0x7F,0x14],[0x24,0x2A,0x7F,0x2A,0x12],[0x23,0x13,8,0x64,0x62],
    [0x36,0x49,0x56,0x20,0x50],[0,8,7,3,0],[0,0x1C,0x22,0x41,0],[0,0x41,0x22,0x1C,0],[0x2A,0x1C,0x7F,0x1C,0x2A],
    [8,8,0x3E,8,8],[0,0x40,0x30,0,0],[8,8,8,8,8],[0,0,0x60,0x60,0],[0x20,0x10,8,4,2],
    [0x3E,0x51,0x49,0x45,0x3E],[0,0x42,0x7F,0x40,0],[0x72,0x49,0x49,0x49,0x46],[0x21,0x41,0x49,0x4D,0x33],
    [0x18,0x14,0x12,0x7F,0x10],[0x27,0x45,0x45,0x45,0x39],[0x3C,0x4A,0x49,0x49,0x31],[0x41,0x21,0x11,9,7],
    [0x36,0x49,0x49,0x49,0x36],[0x46,0x49,0x49,0x29,0x1E],[0,0,0x14,0,0],[0,0x40,0x34,0,0],[0,8,0x14,0x22,0x41],
    [0x14,0x14,0x14,0x14,0x14],[0,0x41,0x22,0x14,8],[2,1,0x59,9,6],[0x3E,0x41,0x5D,0x59,0x4E],
    [0x7C,0x12,0x11,0x12,0x7C],[0x7F,0x49,0x49,0x49,0x36],[0x3E,0x41,0x41,0x41,0x22],[0x7F,0x41,0x41,0x41,0x3E],
    [0x7F,0x49,0x49,0x49,0x41],[0x7F,9,9,9,1],[0x3E,0x41,0x41,0x51,0x73],[0x7F,8,8,8,0x7F],[0,0x41,0x7F,0x41,0],
    [0x20,0x40,0x41,0x3F,1],[0x7F,8,0x14,0x22,0x41],[0x7F,0x40,0x40,0x40,0x40],[0x7F,2,0x1C,2,0x7F],
    [0x7F,4,8,0x10,0x7F],[0x3E,0x41,0x41,0x41,0x3E],[0x7F,9,9,9,6],[0x3E,0x41,0x51,0x21,0x5E],
    [0x7F,9,0x19,0x29,0x46],[0x26,0x49,0x49,0x49,0x32],[3,1,0x7F,1,3],[0x3F,0x40,0x40,0x40,0x3F],
    [0x1F,0x20,0x40,0x20,0x1F],[0x3F,0x40,0x38,0x40,0x3F],[0x63,0x14,8,0x14,0x63],[3,4,0x78,4,3],[0x61,0x59,0x49,0x4D,0x43],
];

const WORDS: [&str; 40] = [
    "OUTDOOR UNIT",
    "MODEL",
    "RATED",
    "VOLTAGE",
    "COOLING",
    "HEATING",
    "CAPACITY",
    "REFRIGERANT",
    "R410A",
    "R32",
    "R22",
    "50HZ",
    "60HZ",
    "1 PH",
    "100V",
    "200V",
    "KG",
    "KW",
    "MASS",
    "SERIAL NO.",
    "CAUTION",
    "WARNING",
    "HIGH VOLTAGE",
    "DO NOT REMOVE COVER",
    "IPX4",
    "MPA",
    "DESIGN PRESSURE",
    "MADE IN",
    "AIR CONDITIONER",
    "CURRENT",
    "INPUT",
    "W",
    "A",
    "COMPRESSOR",
    "FAN MOTOR",
    "GROUND",
    "DISCONNECT POWER",
    "BEFORE SERVICING",
    "SEE MANUAL",
    "INVERTER",
];

/// A letter as strokes on a grid 4 wide and 6 high.
#[rustfmt::skip]
fn strokes(letter: u8) -> &'static [&'static [(f32, f32)]] {
    match letter {
        b'A' => &[&[(0., 6.), (2., 0.), (4., 6.)], &[(0.8, 4.), (3.2, 4.)]],
        b'D' => &[&[(0., 0.), (0., 6.), (2.4, 6.), (4., 4.4), (4., 1.6), (2.4, 0.), (0., 0.)]],
        b'E' => &[&[(4., 0.), (0., 0.), (0., 6.), (4., 6.)], &[(0., 3.), (3.2, 3.)]],
        b'H' => &[&[(0., 0.), (0., 6.)], &[(4., 0.), (4., 6.)], &[(0., 3.), (4., 3.)]],
        b'I' => &[&[(2., 0.), (2., 6.)]],
        b'K' => &[&[(0., 0.), (0., 6.)], &[(4., 0.), (0., 3.6)], &[(1.3, 2.6), (4., 6.)]],
        b'L' => &[&[(0., 0.), (0., 6.), (4., 6.)]],
        b'M' => &[&[(0., 6.), (0., 0.), (2., 3.4), (4., 0.), (4., 6.)]],
        b'N' => &[&[(0., 6.), (0., 0.), (4., 6.), (4., 0.)]],
        b'P' => &[&[(0., 6.), (0., 0.), (3., 0.), (4., 1.), (4., 2.3), (3., 3.3), (0., 3.3)]],
        b'R' => &[&[(0., 6.), (0., 0.), (3., 0.), (4., 1.), (4., 2.2), (3., 3.2), (0., 3.2)], &[(2., 3.2), (4., 6.)]],
        b'S' => &[&[(4., 1.), (3., 0.), (1., 0.), (0., 1.), (0., 2.), (1., 3.), (3., 3.), (4., 4.), (4., 5.), (3., 6.), (1., 6.), (0., 5.)]],
        b'T' => &[&[(0., 0.), (4., 0.)], &[(2., 0.), (2., 6.)]],
        b'U' => &[&[(0., 0.), (0., 4.8), (1.2, 6.), (2.8, 6.), (4., 4.8), (4., 0.)]],
        b'W' => &[&[(0., 0.), (1., 6.), (2., 2.6), (3., 6.), (4., 0.)]],
        b'Z' => &[&[(0., 0.), (4., 0.), (0., 6.), (4., 6.)]],
        _ => &[&[(1.2, 0.), (2.8, 0.), (4., 1.2), (4., 4.8), (2.8, 6.), (1.2, 6.), (0., 4.8), (0., 1.2), (1.2, 0.)]],
    }
}

impl Print {
    fn blank(width_mm: f32, height_mm: f32, ground: [f32; 3], cover: f32, inks: &[[f32; 3]]) -> Self {
        let (width, height) = ((width_mm * DOTS) as usize, (height_mm * DOTS) as usize);
        Self {
            width,
            height,
            dots: vec![0; width * height],
            inks: std::iter::once((ground, cover))
                .chain(inks.iter().map(|&i| (i, 1.0)))
                .collect(),
        }
    }

    pub fn width_mm(&self) -> f32 {
        self.width as f32 / DOTS
    }

    pub fn height_mm(&self) -> f32 {
        self.height as f32 / DOTS
    }

    /// Linear RGB and cover at a place, mm from the middle; `None` off the label.
    pub fn at(&self, x_mm: f32, y_mm: f32) -> Option<([f32; 3], f32)> {
        let gx = x_mm * DOTS + 0.5 * (self.width as f32 - 1.0);
        let gy = y_mm * DOTS + 0.5 * (self.height as f32 - 1.0);
        if gx < 0.0 || gy < 0.0 || gx >= (self.width - 1) as f32 || gy >= (self.height - 1) as f32 {
            return None;
        }
        let (ix, iy) = (gx as usize, gy as usize);
        let (fx, fy) = (gx - ix as f32, gy - iy as f32);
        let i = iy * self.width + ix;
        let corner = |i: usize| &self.inks[self.dots[i] as usize];
        if self.dots[i] == self.dots[i + 1] && self.dots[i] == self.dots[i + self.width] {
            return Some(*corner(i));
        }
        let parts = [
            (corner(i), (1.0 - fx) * (1.0 - fy)),
            (corner(i + 1), fx * (1.0 - fy)),
            (corner(i + self.width), (1.0 - fx) * fy),
            (corner(i + self.width + 1), fx * fy),
        ];
        let mut color = [0.0; 3];
        let mut cover = 0.0;
        for ((c, a), w) in parts {
            for k in 0..3 {
                color[k] += w * a * c[k];
            }
            cover += w * a;
        }
        (cover > 0.0).then(|| (color.map(|v| v / cover), cover))
    }

    fn fill(&mut self, x_mm: f32, y_mm: f32, w_mm: f32, h_mm: f32, ink: u8) {
        let dot = |v: f32, n: usize| ((v * DOTS).round().max(0.0) as usize).min(n);
        let (x0, x1) = (dot(x_mm, self.width), dot(x_mm + w_mm, self.width));
        for y in dot(y_mm, self.height)..dot(y_mm + h_mm, self.height) {
            self.dots[y * self.width + x0..y * self.width + x1].fill(ink);
        }
    }

    /// Text whose letters are `size_mm` high; returns where it ends, mm.
    fn text(&mut self, x_mm: f32, y_mm: f32, size_mm: f32, text: &str, ink: u8) -> f32 {
        let dot = size_mm / 7.0;
        let mut x = x_mm;
        for byte in text.bytes() {
            let glyph = FONT[(byte.to_ascii_uppercase().clamp(32, 90) - 32) as usize];
            for (column, bits) in glyph.iter().enumerate() {
                for row in 0..7 {
                    if bits >> row & 1 == 1 {
                        self.fill(
                            x + column as f32 * dot,
                            y_mm + row as f32 * dot,
                            dot + 0.08,
                            dot + 0.08,
                            ink,
                        );
                    }
                }
            }
            x += 6.0 * dot;
        }
        x
    }

    fn disc(&mut self, x_mm: f32, y_mm: f32, outer: f32, inner: f32, ink: u8) {
        for y in 0..self.height {
            for x in 0..self.width {
                let d = (x as f32 / DOTS - x_mm).hypot(y as f32 / DOTS - y_mm);
                if d < outer && d >= inner {
                    self.dots[y * self.width + x] = ink;
                }
            }
        }
    }

    /// A name plate: model, table of figures, bar code.
    pub fn plate<R: RngExt + ?Sized>(model: &str, rng: &mut R) -> Self {
        let (w, h) = (rng.random_range(60.0..130.0f32), rng.random_range(40.0..85.0f32));
        let black = [0.03; 3];
        let (ground, ink) = match rng.random_range(0..5) {
            0 | 1 => ([0.8, 0.8, 0.78], black),
            2 => ([0.5, 0.5, 0.5], black),
            3 => ([0.05, 0.12, 0.35], [0.75; 3]),
            _ => ([0.7, 0.68, 0.5], black),
        };
        let mut p = Self::blank(w, h, ground, 1.0, &[ink, [0.5, 0.03, 0.03]]);
        let frame = 0.4;
        for (x, y, fw, fh) in [
            (1.0, 1.0, w - 2.0, frame),
            (1.0, h - 1.5, w - 2.0, frame),
            (1.0, 1.0, frame, h - 2.2),
            (w - 1.5, 1.0, frame, h - 2.2),
        ] {
            p.fill(x, y, fw, fh, 1);
        }
        let mut y = 3.0;
        let title = rng.random_range(2.8..4.5);
        p.text(3.0, y, title, model, 1);
        y += title + 2.0;
        let bar_top = h - 13.0;
        while y < bar_top - 2.0 {
            let size = rng.random_range(1.5..2.4);
            let mut x = 3.0;
            while x < w - 18.0 {
                let word = WORDS[rng.random_range(0..WORDS.len())];
                if x + word.len() as f32 * size * 0.86 > w - 3.0 {
                    break;
                }
                x = p.text(x, y, size, word, 1) + rng.random_range(1.0..5.0);
                if rng.random_bool(0.5) {
                    let figure = format!("{}.{}", rng.random_range(0..99), rng.random_range(0..99));
                    if x + figure.len() as f32 * size * 0.86 < w - 3.0 {
                        x = p.text(x, y, size, &figure, 1) + 2.0;
                    }
                }
            }
            y += size + rng.random_range(0.8..1.6);
            if rng.random_bool(0.3) {
                p.fill(2.0, y, w - 4.0, 0.25, 1);
                y += 1.0;
            }
        }
        if h > 35.0 {
            let mut x = 5.0;
            let end = w * rng.random_range(0.5..0.9);
            while x < end {
                let bar = [0.25, 0.5, 0.75][rng.random_range(0..3)];
                p.fill(x, bar_top, bar, 7.0, 1);
                x += bar + [0.25, 0.5, 0.75][rng.random_range(0..3)];
            }
            let digits: String = (0..12).map(|_| char::from(b'0' + rng.random_range(0..10u8))).collect();
            p.text(8.0, bar_top + 8.0, 1.8, &digits, 1);
        }
        p
    }

    /// A warning sign: coloured head with lines of text and a pictogram.
    pub fn warning<R: RngExt + ?Sized>(rng: &mut R) -> Self {
        let (w, h) = (rng.random_range(35.0..80.0f32), rng.random_range(22.0..50.0f32));
        let head = [[0.75, 0.38, 0.02], [0.55, 0.03, 0.03], [0.72, 0.6, 0.03]][rng.random_range(0..3)];
        let mut p = Self::blank(w, h, [0.82, 0.82, 0.8], 1.0, &[[0.03; 3], head]);
        p.fill(0.0, 0.0, w, 7.0, 2);
        p.text(
            9.0,
            1.6,
            4.0,
            if rng.random_bool(0.5) { "WARNING" } else { "CAUTION" },
            1,
        );
        // triangle with a mark
        for k in 0..20 {
            let t = k as f32 / 20.0;
            p.fill(4.5 - 3.0 * t, 1.0 + 5.0 * t, 6.0 * t, 0.3, 1);
        }
        let mut y = 9.0;
        while y < h - 3.0 {
            let size = rng.random_range(1.5..2.2);
            let word = WORDS[rng.random_range(0..WORDS.len())];
            p.text(2.5, y, size, word, 1);
            y += size + 1.2;
        }
        if w > 50.0 && h > 25.0 {
            p.disc(w - 10.0, h - 11.0, 6.0, 5.2, 2);
            p.fill(w - 14.0, h - 11.4, 8.0, 0.8, 2);
        }
        p
    }

    /// A brand's name printed straight on the sheet, in drawn letters.
    pub fn brand<R: RngExt + ?Sized>(rng: &mut R) -> Self {
        let names = [
            "KAZE", "NORDAIR", "TOKIWA", "AEROLINE", "HOKUTO", "SUZUKAZE", "POLARIS", "MISTRAL",
        ];
        let size = rng.random_range(7.0..20.0f32);
        let name = names[rng.random_range(0..names.len())];
        let color = [[0.04, 0.07, 0.25], [0.45, 0.03, 0.04], [0.12; 3], [0.35; 3]][rng.random_range(0..4)];
        let unit = size / 6.0;
        let wide = rng.random_range(0.75..1.3) * unit;
        let half = rng.random_range(0.28..0.62) * unit;
        let slant = if rng.random_bool(0.4) { 0.2 } else { 0.0 };
        let step = 4.0 * wide + 1.5 * unit;
        let length = step * name.len() as f32 + 2.0 * half + slant * size + 2.0;
        let mut p = Self::blank(length, size + 2.0 * half + 2.0, [0.5; 3], 0.0, &[color]);
        for (k, letter) in name.bytes().enumerate() {
            for stroke in strokes(letter) {
                for pair in stroke.windows(2) {
                    let at = |(x, y): (f32, f32)| {
                        (
                            1.0 + half + k as f32 * step + wide * x + slant * (6.0 - y) * unit,
                            1.0 + half + y * unit,
                        )
                    };
                    p.line(at(pair[0]), at(pair[1]), half);
                }
            }
        }
        p
    }

    /// A line of the first ink with round ends.
    fn line(&mut self, a: (f32, f32), b: (f32, f32), half: f32) {
        let dot = |v: f32, n: usize| ((v * DOTS).max(0.0) as usize).min(n);
        let (ex, ey) = (b.0 - a.0, b.1 - a.1);
        for y in dot(a.1.min(b.1) - half, self.height)..dot(a.1.max(b.1) + half + 1.0, self.height) {
            for x in dot(a.0.min(b.0) - half, self.width)..dot(a.0.max(b.0) + half + 1.0, self.width) {
                let (px, py) = (x as f32 / DOTS - a.0, y as f32 / DOTS - a.1);
                let t = ((px * ex + py * ey) / (ex * ex + ey * ey).max(1e-6)).clamp(0.0, 1.0);
                if (px - t * ex).hypot(py - t * ey) < half {
                    self.dots[y * self.width + x] = 1;
                }
            }
        }
    }

    /// A small sticker with a few characters or a sign.
    pub fn sticker<R: RngExt + ?Sized>(rng: &mut R) -> Self {
        let (w, h) = (rng.random_range(14.0..40.0f32), rng.random_range(10.0..24.0f32));
        let ground = [
            [0.8, 0.8, 0.78],
            [0.75, 0.62, 0.05],
            [0.1, 0.3, 0.12],
            [0.5, 0.06, 0.05],
        ][rng.random_range(0..4)];
        let mut p = Self::blank(w, h, ground, 1.0, &[[0.03; 3]]);
        match rng.random_range(0..4) {
            0 => {
                let r = 0.36 * h;
                p.disc(0.5 * w, 0.5 * h, r, r - 0.7, 1);
                p.fill(0.5 * w - 0.5 * r, 0.5 * h - 0.35, r, 0.7, 1);
                if rng.random_bool(0.5) {
                    p.fill(0.5 * w - 0.35, 0.5 * h - 0.5 * r, 0.7, r, 1);
                }
            }
            _ => {
                let size = (0.4 * h).min(0.2 * w);
                let text: String = (0..4).map(|_| char::from(b'0' + rng.random_range(0..42u8))).collect();
                p.text(1.5, 0.3 * h, size, &text, 1);
            }
        }
        p
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn a_plate_has_ink_on_its_ground_and_an_end() {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(4);
        let plate = Print::plate("RAS-2245", &mut rng);
        let share = plate.dots.iter().filter(|&&d| d == 1).count() as f32 / plate.dots.len() as f32;
        assert!((0.05..0.6).contains(&share), "{share}");
        assert!(plate.at(0.0, 0.0).is_some());
        assert!(plate.at(plate.width_mm(), 0.0).is_none());
    }
}
