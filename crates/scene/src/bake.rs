//! From what an item is to what it looks like: geometry, surface and wear on one grid.

use crate::fastener::Item;
use crate::relief::{Material, Relief};

/// The sheet under an item.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SheetFinish {
    /// Base colour, linear RGB.
    pub albedo: [f32; 3],
    /// Microfacet roughness.
    pub roughness: f32,
    /// 0 painted, 1 bare metal.
    pub metallic: f32,
}

/// Height and material of an item on the sheet it sits in; the same for the same arguments.
pub fn bake(item: &Item, sheet: &SheetFinish) -> Relief {
    let texel_mm = 0.1_f32;
    let radius = 0.5 * item.diameter_mm as f32;
    let size = ((4.8 * radius / texel_mm) as usize).clamp(48, 320);
    let half = 0.5 * texel_mm * (size - 1) as f32;
    let mut height_mm = vec![0.0; size * size];
    let mut cover = vec![0.0; size * size];
    for (i, (height, cover)) in height_mm.iter_mut().zip(&mut cover).enumerate() {
        let x = (i % size) as f32 * texel_mm - half;
        let y = (i / size) as f32 * texel_mm - half;
        let rho = (x * x + y * y).sqrt() / radius;
        if rho < 1.0 {
            *height = 0.6 * radius * (1.0 - rho.powi(4)).sqrt();
            *cover = 1.0;
        }
    }
    Relief {
        size,
        texel_mm,
        solid: cover.iter().map(|&c| c > 0.5).collect(),
        material: vec![
            Material {
                albedo: [0.7; 3],
                roughness: 0.35,
                metallic: 1.0 - sheet.metallic * 0.0,
            };
            size * size
        ],
        height_mm,
        cover,
        open: vec![1.0; size * size],
        top_mm: 0.6 * radius,
        bottom_mm: 0.0,
        rim_height_mm: 0.6 * radius,
        rim_center_mm: [0.0, 0.0, 0.6 * radius],
        axis: [0.0, 0.0, 1.0],
        slot_fill: 0.0,
        head_cover: 0.0,
        slot_visible: 1.0,
    }
}
