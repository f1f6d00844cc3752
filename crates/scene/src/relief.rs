//! A baked item: height and material on a square grid over the sheet around it.

/// Material of one texel. Colours are linear RGB reflectance, 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Diffuse or specular base colour, linear RGB.
    pub albedo: [f32; 3],
    /// Microfacet roughness, 0.05 (mirror) to 1.
    pub roughness: f32,
    /// 0 dielectric, 1 metal.
    pub metallic: f32,
}

/// Height field and material of an item, centred on it, axes of the face (x right, y down), before tilt and lift.
#[derive(Clone, Debug, PartialEq)]
pub struct Relief {
    /// Texels per side.
    pub size: usize,
    /// Side of a texel, mm.
    pub texel_mm: f32,
    /// Height above the sheet, mm (negative: below it), row by row.
    pub height_mm: Vec<f32>,
    /// Material where the item or its dirt covers the sheet.
    pub material: Vec<Material>,
    /// How much of the sheet's own material is covered, 0 to 1 (rust bleeding and grime fade out).
    pub cover: Vec<f32>,
    /// True where the texel belongs to the solid item itself (head, rim), not to the sheet around it: only this part moves with tilt and lift.
    pub solid: Vec<bool>,
    /// Light that reaches the bottom, 0 (black hole) to 1 (open): baked occlusion, inter-reflection included.
    pub open: Vec<f32>,
    /// Height of the recess rim above the sheet at the item's axis, mm: the plane in which the driver aims.
    pub rim_height_mm: f32,
    /// Share of the recess filled or painted over, 0 to 1.
    pub slot_fill: f32,
    /// Share of the head covered by dirt, mud or paint lumps, 0 to 1.
    pub head_cover: f32,
    /// Share of the slot's area that can still be seen (not hidden by webs or lumps), 0 to 1.
    pub slot_visible: f32,
}
