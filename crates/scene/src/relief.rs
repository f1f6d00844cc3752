//! A baked item: height and material on a square grid over the sheet around it, and how rays meet it.
//!
//! Axes are those of the face: x right, y down, heights out of the sheet toward the viewer; the origin is the item's own place on
//! the sheet. Directions are `[x, y, height]`.

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

/// Height field and material of an item, centred on it, axes of the face (x right, y down), tilt and lift applied.
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
    /// Highest point of the grid, mm: no view ray needs to start above it.
    pub top_mm: f32,
    /// Lowest point of the grid, mm.
    pub bottom_mm: f32,
    /// Height of the recess rim above the sheet at the item's axis, mm: the plane in which the driver aims.
    pub rim_height_mm: f32,
    /// Centre of the recess in the plane of its rim (of the top face, where there is no recess), mm from the item's place, tilt and lift included.
    pub rim_center_mm: [f32; 3],
    /// Unit vector along the item's axis, out of the sheet.
    pub axis: [f32; 3],
    /// Share of the recess filled or painted over, 0 to 1.
    pub slot_fill: f32,
    /// Share of the head covered by dirt, mud or paint lumps, 0 to 1.
    pub head_cover: f32,
    /// Share of the slot's area that can still be seen (not hidden by webs or lumps), 0 to 1.
    pub slot_visible: f32,
}

/// A place in the grid between four texels.
struct Cell {
    index: usize,
    fx: f32,
    fy: f32,
}

impl Relief {
    /// Half the side of the grid, mm.
    pub fn half_mm(&self) -> f32 {
        0.5 * self.texel_mm * (self.size - 1) as f32
    }

    /// Whether a place on the sheet lies inside the grid.
    pub fn contains(&self, x_mm: f32, y_mm: f32) -> bool {
        let half = self.half_mm();
        x_mm.abs() <= half && y_mm.abs() <= half
    }

    #[inline]
    fn cell(&self, x_mm: f32, y_mm: f32) -> Cell {
        let last = (self.size - 1) as f32;
        let gx = (x_mm / self.texel_mm + 0.5 * last).clamp(0.0, last - 0.001);
        let gy = (y_mm / self.texel_mm + 0.5 * last).clamp(0.0, last - 0.001);
        let (ix, iy) = (gx as usize, gy as usize);
        Cell {
            index: iy * self.size + ix,
            fx: gx - ix as f32,
            fy: gy - iy as f32,
        }
    }

    #[inline]
    fn bilinear(&self, field: &[f32], x_mm: f32, y_mm: f32) -> f32 {
        let Cell { index, fx, fy } = self.cell(x_mm, y_mm);
        let top = field[index] + fx * (field[index + 1] - field[index]);
        let below = index + self.size;
        let bottom = field[below] + fx * (field[below + 1] - field[below]);
        top + fy * (bottom - top)
    }

    /// Height above the sheet, mm; outside the grid that of its border (0).
    #[inline]
    pub fn height(&self, x_mm: f32, y_mm: f32) -> f32 {
        self.bilinear(&self.height_mm, x_mm, y_mm)
    }

    /// Baked openness to the surroundings, 0 to 1.
    pub fn open(&self, x_mm: f32, y_mm: f32) -> f32 {
        self.bilinear(&self.open, x_mm, y_mm)
    }

    /// Whether a place belongs to the item's own body rather than to the sheet around it.
    pub fn is_solid(&self, x_mm: f32, y_mm: f32) -> bool {
        let Cell { index, fx, fy } = self.cell(x_mm, y_mm);
        let (right, below) = (usize::from(fx > 0.5), usize::from(fy > 0.5));
        self.solid[index + right + below * self.size]
    }

    /// Unit normal of the surface.
    pub fn normal(&self, x_mm: f32, y_mm: f32) -> [f32; 3] {
        let step = self.texel_mm;
        let dx = (self.height(x_mm + step, y_mm) - self.height(x_mm - step, y_mm)) / (2.0 * step);
        let dy = (self.height(x_mm, y_mm + step) - self.height(x_mm, y_mm - step)) / (2.0 * step);
        let scale = 1.0 / (1.0 + dx * dx + dy * dy).sqrt();
        [-dx * scale, -dy * scale, scale]
    }

    /// Material of the item or its dirt, and how much of the sheet's own material it covers (0 to 1).
    pub fn material(&self, x_mm: f32, y_mm: f32) -> (Material, f32) {
        let Cell { index, fx, fy } = self.cell(x_mm, y_mm);
        let corners = [
            (index, (1.0 - fx) * (1.0 - fy)),
            (index + 1, fx * (1.0 - fy)),
            (index + self.size, (1.0 - fx) * fy),
            (index + self.size + 1, fx * fy),
        ];
        let mut sum = Material {
            albedo: [0.0; 3],
            roughness: 0.0,
            metallic: 0.0,
        };
        // Weighted by cover, so that a bare texel's placeholder colour never bleeds into the item's edge.
        let (mut cover, mut weights) = (0.0, 0.0);
        for (i, weight) in corners {
            let c = &self.material[i];
            cover += weight * self.cover[i];
            let weight = weight * (self.cover[i] + 1e-4);
            weights += weight;
            for (a, b) in sum.albedo.iter_mut().zip(c.albedo) {
                *a += weight * b;
            }
            sum.roughness += weight * c.roughness;
            sum.metallic += weight * c.metallic;
        }
        let scale = 1.0 / weights;
        let material = Material {
            albedo: sum.albedo.map(|a| a * scale),
            roughness: sum.roughness * scale,
            metallic: sum.metallic * scale,
        };
        (material, cover)
    }

    /// Where a view ray first meets the surface, or `None` where it passes the grid by.
    ///
    /// `direction` points into the sheet (negative height component), any length; `origin` lies anywhere on the ray.
    pub fn march(&self, origin: [f32; 3], direction: [f32; 3]) -> Option<[f32; 3]> {
        if direction[2] > -1e-4 {
            return None;
        }
        let at = |height: f32| {
            let s = (height - origin[2]) / direction[2];
            [origin[0] + s * direction[0], origin[1] + s * direction[1]]
        };
        let start_mm = self.top_mm + 0.01;
        let end_mm = self.bottom_mm - 0.01;
        let (from, to) = (at(start_mm), at(end_mm));
        let travel = ((to[0] - from[0]).powi(2) + (to[1] - from[1]).powi(2)).sqrt();
        // One look about every texel crossed: no wall is thinner than that.
        let steps = ((travel / (0.8 * self.texel_mm)).ceil() as usize).clamp(2, 256);
        let mut above = 0.0_f32;
        let mut inside = false;
        for i in 0..=steps {
            let t = i as f32 / steps as f32;
            let x = from[0] + t * (to[0] - from[0]);
            let y = from[1] + t * (to[1] - from[1]);
            let height = start_mm + t * (end_mm - start_mm);
            if !self.contains(x, y) {
                if inside {
                    return None;
                }
                above = t;
                continue;
            }
            inside = true;
            if height > self.height(x, y) {
                above = t;
                continue;
            }
            let (mut lo, mut hi) = (above, t);
            for _ in 0..7 {
                let mid = 0.5 * (lo + hi);
                let x = from[0] + mid * (to[0] - from[0]);
                let y = from[1] + mid * (to[1] - from[1]);
                if start_mm + mid * (end_mm - start_mm) > self.height(x, y) {
                    lo = mid;
                } else {
                    hi = mid;
                }
            }
            let x = from[0] + hi * (to[0] - from[0]);
            let y = from[1] + hi * (to[1] - from[1]);
            return self.contains(x, y).then(|| [x, y, self.height(x, y)]);
        }
        None
    }

    /// Share of a light that reaches a point (of the item or of the sheet near it, also outside the grid), 0 to 1.
    ///
    /// `toward` is the unit direction to the light, `softness` the tangent of the light's angular radius.
    pub fn visibility(&self, point: [f32; 3], toward: [f32; 3], softness: f32) -> f32 {
        let run = (toward[0] * toward[0] + toward[1] * toward[1]).sqrt();
        if toward[2] <= 0.0 {
            return 0.0;
        }
        let clear_mm = self.top_mm - point[2];
        if run < 1e-3 || clear_mm <= 0.02 {
            return 1.0;
        }
        let rise = toward[2] / run;
        let (ux, uy) = (toward[0] / run, toward[1] / run);
        // The cone's lower edge may still be under the top when its axis is above it.
        let reach = (clear_mm / (rise - softness).max(0.15)).min(4.0 * self.half_mm());
        // Steps grow with distance: near occluders cast the sharp shadows.
        let mut s = 0.9 * self.texel_mm;
        let mut lit = 1.0_f32;
        let soft = softness.max(0.01);
        while s < reach {
            let (x, y) = (point[0] + s * ux, point[1] + s * uy);
            if self.contains(x, y) {
                let over = point[2] + s * rise + 0.01 - self.height(x, y);
                let spread = soft * (s + 0.02) + 0.02;
                lit = lit.min(0.5 + 0.5 * over / spread);
                if lit <= 0.0 {
                    return 0.0;
                }
            } else if (x * ux + y * uy) > 0.0 && s > 2.0 * self.texel_mm {
                break;
            }
            s *= 1.12;
            s += 0.35 * self.texel_mm;
        }
        lit * lit * (3.0 - 2.0 * lit)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// A block 2 mm high and 4 mm wide on a sheet of 16 mm.
    fn block() -> Relief {
        let (size, texel_mm) = (161, 0.1_f32);
        let inside = |i: usize| {
            let (x, y) = (i % size, i / size);
            x.abs_diff(80) <= 20 && y.abs_diff(80) <= 20
        };
        let cells = size * size;
        Relief {
            size,
            texel_mm,
            height_mm: (0..cells).map(|i| if inside(i) { 2.0 } else { 0.0 }).collect(),
            material: vec![
                Material {
                    albedo: [0.5; 3],
                    roughness: 0.5,
                    metallic: 0.0
                };
                cells
            ],
            cover: (0..cells).map(|i| if inside(i) { 1.0 } else { 0.0 }).collect(),
            solid: (0..cells).map(inside).collect(),
            open: vec![1.0; cells],
            top_mm: 2.0,
            bottom_mm: 0.0,
            rim_height_mm: 2.0,
            rim_center_mm: [0.0, 0.0, 2.0],
            axis: [0.0, 0.0, 1.0],
            slot_fill: 0.0,
            head_cover: 0.0,
            slot_visible: 1.0,
        }
    }

    #[test]
    fn a_ray_meets_top_side_and_sheet_where_geometry_says() {
        let relief = block();
        let top = relief.march([1.0, 0.5, 0.0], [0.0, 0.0, -1.0]).unwrap();
        assert!((top[2] - 2.0).abs() < 1e-3 && (top[0] - 1.0).abs() < 1e-3);
        // Slanted by 45 degrees toward -x, aimed at x = 1 in the sheet: it hits the side (x = 2) at height 1.
        let side = relief.march([1.0, 0.0, 0.0], [-1.0, 0.0, -1.0]).unwrap();
        assert!(
            (side[0] - 2.05).abs() < 0.12 && (side[2] - 1.0).abs() < 0.15,
            "{side:?}"
        );
        let sheet = relief.march([5.0, 0.0, 0.0], [-0.3, 0.0, -1.0]).unwrap();
        assert!((sheet[0] - 5.0).abs() < 0.02 && sheet[2].abs() < 1e-3);
        assert!(relief.march([9.0, 0.0, 0.0], [0.0, 0.0, -1.0]).is_none());
    }

    #[test]
    fn the_shadow_ends_where_the_light_clears_the_edge() {
        let relief = block();
        let toward = [-std::f32::consts::FRAC_1_SQRT_2, 0.0, std::f32::consts::FRAC_1_SQRT_2];
        // Behind the block (+x) a light at 45 degrees leaves 2 mm of shadow.
        assert!(relief.visibility([3.0, 0.0, 0.0], toward, 0.01) < 0.05);
        assert!(relief.visibility([4.7, 0.0, 0.0], toward, 0.01) > 0.9);
        assert!(relief.visibility([-3.0, 0.0, 0.0], toward, 0.01) > 0.99);
        let edge = relief.visibility([4.05, 0.0, 0.0], toward, 0.3);
        assert!((0.1..0.9).contains(&edge), "a wide light has a half-shadow: {edge}");
    }

    #[test]
    fn the_edge_of_an_item_keeps_its_own_colour() {
        let mut relief = block();
        for (m, c) in relief.material.iter_mut().zip(&relief.cover) {
            m.albedo = if *c > 0.5 { [0.8, 0.1, 0.1] } else { [0.0, 0.9, 0.0] };
        }
        let (material, cover) = relief.material(2.04, 0.0);
        assert!(cover > 0.2 && cover < 0.8 && material.albedo[1] < 0.11);
    }
}
