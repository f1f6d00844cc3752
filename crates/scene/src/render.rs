//! Pictures of faces: rays through the lens onto sheets and items, light, then the sensor.
//!
//! The picture is made of blocks of 16 x 16 pixels, each on its own: a region of interest costs only the blocks it
//! touches and has the same pixels as the whole picture, whatever the number of threads.

use crate::bake::{SheetFinish, bake};
use crate::fastener::{Decoy, Item, Kind};
use crate::layer::{Bump, Cutout, Layer, Ray, Tube, segment_foot};
use crate::paint::Decal;
use crate::product::Placed;
use crate::relief::{Material, Relief};
use crate::shade::{Incoming, Lighting};
use crate::shape::{Bounds, Xy};
use crate::view::{FaceView, Roi};
use geometry::{DepthMap, Pixel, RgbImage};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use std::sync::OnceLock;

/// Side of a block, px.
pub(crate) const BLOCK: usize = 16;

/// A picture with its registered depth.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// Colour of the region.
    pub color: RgbImage,
    /// Depth of half the resolution; its pixel (0, 0) is at `origin` / 2.
    pub depth: DepthMap,
    /// Pixel of the whole picture at the region's corner.
    pub origin: [u32; 2],
}

/// Renders a face, or only a region of its picture. For several regions of one view, [`Prepared`] saves work.
pub fn render(view: &FaceView, roi: Option<Roi>) -> Rendered {
    Prepared::new(view).render(roi)
}

/// A view made ready to be rendered: background, lights, and the items' reliefs, each made once when first seen.
pub struct Prepared {
    view: FaceView,
    pub(crate) layers: Vec<Layer>,
    pub(crate) tubes: Vec<Tube>,
    pub(crate) spots: Vec<Spot>,
    lighting: Lighting,
}

/// An item at its place.
pub(crate) struct Spot {
    pub placed: Placed,
    /// The layer it sits in.
    layer: usize,
    bounds: Bounds,
    relief: OnceLock<Relief>,
}

/// Linear colour and depth of a block.
pub(crate) struct Block {
    pub color: [[f32; 3]; BLOCK * BLOCK],
    pub depth_mm: [f32; BLOCK * BLOCK],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    Top,
    Wall,
    Cut(usize),
    Tube,
    Nothing,
}

/// What a ray meets first.
#[derive(Clone, Copy, Debug)]
struct Hit {
    height: f32,
    at: Xy,
    layer: usize,
    part: Part,
}

impl Hit {
    fn same_surface(&self, other: &Hit) -> bool {
        self.layer == other.layer && self.part == other.part
    }
}

/// A layer as far as it can be seen in a block.
struct Near<'a> {
    index: usize,
    layer: &'a Layer,
    cutouts: Vec<&'a Cutout>,
    bumps: Vec<&'a Bump>,
    decals: Vec<&'a Decal>,
    /// The block lies wholly within the outline.
    inside: bool,
    /// Radius of the outline's edge, 0 where the edge is far.
    edge_mm: f32,
    /// What changes too slowly to be followed within a block: height and slope at its middle.
    slow: Slow,
}

/// A plane that stands for a slow change of height.
#[derive(Clone, Copy, Default)]
struct Slow {
    center: Xy,
    height: f32,
    slope: Xy,
}

impl Near<'_> {
    #[inline]
    fn is_flat(&self) -> bool {
        self.bumps.is_empty() && self.edge_mm <= 0.0
    }

    #[inline]
    fn rise(&self, p: Xy) -> f32 {
        let slow = &self.slow;
        let mut h = slow.height + slow.slope[0] * (p[0] - slow.center[0]) + slow.slope[1] * (p[1] - slow.center[1]);
        for bump in &self.bumps {
            h += bump.height(p);
        }
        let edge = self.edge_mm;
        if edge > 0.0 {
            let d = self.layer.shape.distance(p) + edge;
            if d > 0.0 {
                let d = d.min(0.98 * edge);
                h -= edge - (edge * edge - d * d).max(0.0).sqrt();
            }
        }
        h
    }
}

/// A layer that may keep light from a block.
struct Caster<'a> {
    index: usize,
    layer: &'a Layer,
    cutouts: Vec<&'a Cutout>,
}

impl Caster<'_> {
    /// Positive outside the sheet or in an opening.
    #[inline]
    fn solid_distance(&self, p: Xy) -> f32 {
        let mut d = self.layer.shape.distance(p);
        for cutout in &self.cutouts {
            d = d.max(-cutout.shape.distance(p));
        }
        d
    }
}

/// What can be seen in a block.
struct Nearby<'a> {
    layers: Vec<Near<'a>>,
    /// (tube, segment)
    segments: Vec<(usize, usize)>,
    spots: Vec<(&'a Spot, &'a Relief)>,
}

/// What keeps light from a block.
struct Shade<'a> {
    /// For every light: the share that passes what blurs into a veil, and the sheets that may be in its way.
    lights: Vec<(f32, Vec<Caster<'a>>)>,
    /// Sheets that hide part of the surroundings.
    open: Vec<Caster<'a>>,
    /// (tube, segment) for every light.
    segments: Vec<Vec<(usize, usize)>>,
}

fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + t * (b - a)
}

/// Rays of a block, interpolated between its corners: the lens is smooth over 16 pixels (error below 0.002 px).
struct Rays {
    corners: [[f32; 6]; 4],
}

impl Rays {
    fn new(view: &FaceView, x_px: i64, y_px: i64) -> Self {
        let face_from_camera = view.camera_from_face.inverse();
        let origin = face_from_camera.isometry().translation.vector;
        let rotation = face_from_camera.isometry().rotation;
        let side = BLOCK as i64;
        let corners = [(0, 0), (side, 0), (0, side), (side, side)].map(|(dx, dy)| {
            let [x, y] = view.camera.ray(Pixel::new((x_px + dx) as f64, (y_px + dy) as f64));
            let d = rotation * nalgebra::Vector3::new(x, y, 1.0);
            let t0 = -origin.z / d.z;
            [
                (origin.x + t0 * d.x) as f32,
                (origin.y + t0 * d.y) as f32,
                (-d.x / d.z) as f32,
                (-d.y / d.z) as f32,
                t0 as f32,
                (1.0 / d.z) as f32,
            ]
        });
        Self { corners }
    }

    /// Ray, depth at height 0 and loss of depth per height at a place in the block, px from its first pixel's centre.
    #[inline]
    fn at(&self, x: f32, y: f32) -> (Ray, f32, f32) {
        let (fx, fy) = (x / BLOCK as f32, y / BLOCK as f32);
        let c = &self.corners;
        let v: [f32; 6] = std::array::from_fn(|k| lerp(lerp(c[0][k], c[1][k], fx), lerp(c[2][k], c[3][k], fx), fy));
        (
            Ray {
                at: [v[0], v[1]],
                slope: [v[2], v[3]],
            },
            v[4],
            v[5],
        )
    }
}

impl Prepared {
    /// Makes a view ready.
    pub fn new(view: &FaceView) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(view.scene_seed);
        let lighting = Lighting::sample(&mut rng);
        let mut sheetwork = view.design.sheetwork.clone();
        crate::backdrop::surround(&mut sheetwork, &view.design, &mut rng);
        let mut layers = sheetwork.layers;
        layers.iter_mut().for_each(Layer::settle);
        layers.sort_by(|a, b| b.top_mm.total_cmp(&a.top_mm));
        let mut spots: Vec<Spot> = Vec::new();
        for screw in &view.design.screws {
            let mut placed = screw.placed.clone();
            if view.removed_screws.contains(&screw.id) {
                placed.item = empty_hole(&screw.placed.item);
            }
            spots.push(Spot::new(placed, &layers));
        }
        spots.extend(view.design.decoys.iter().map(|d| Spot::new(d.clone(), &layers)));
        Self {
            view: view.clone(),
            layers,
            tubes: sheetwork.tubes,
            spots,
            lighting,
        }
    }

    /// The view.
    pub fn view(&self) -> &FaceView {
        &self.view
    }

    pub(crate) fn relief<'a>(&'a self, spot: &'a Spot) -> &'a Relief {
        spot.relief.get_or_init(|| {
            let paint = &self.layers[spot.layer].paint;
            let finish = SheetFinish {
                albedo: paint.albedo,
                roughness: paint.roughness,
                metallic: paint.metallic(),
            };
            bake(&spot.placed.item, &finish)
        })
    }

    /// Whether a sheet, bar or cable stands between the camera and a place of an item.
    pub(crate) fn hidden(&self, spot: &Spot, local_mm: [f32; 3]) -> bool {
        let p: [f64; 3] = [
            spot.placed.at_mm[0] + f64::from(local_mm[0]),
            spot.placed.at_mm[1] + f64::from(local_mm[1]),
            spot.placed.height_mm + f64::from(local_mm[2]),
        ];
        let face_from_camera = self.view.camera_from_face.inverse();
        let eye = face_from_camera.isometry().translation.vector;
        // the eye's height is -z: z runs into the sheet
        let climb = -eye.z - p[2];
        let slope = [((eye.x - p[0]) / climb) as f32, ((eye.y - p[1]) / climb) as f32];
        let at = [
            (p[0] - p[2] * f64::from(slope[0])) as f32,
            (p[1] - p[2] * f64::from(slope[1])) as f32,
        ];
        let ray = Ray { at, slope };
        let nearby = self.nearby_rays([ray; 4], false);
        self.meet(&nearby, &ray).height > p[2] as f32 + 0.6
    }

    /// Renders the picture, or only a region of it.
    pub fn render(&self, roi: Option<Roi>) -> Rendered {
        crate::sensor::expose(self, roi.unwrap_or(self.whole()), true)
    }

    /// As [`render`](Self::render), without blur, noise or compression: what a perfect camera would record.
    pub fn render_ideal(&self, roi: Option<Roi>) -> Rendered {
        crate::sensor::expose(self, roi.unwrap_or(self.whole()), false)
    }

    fn whole(&self) -> Roi {
        Roi {
            x_px: 0,
            y_px: 0,
            width_px: self.view.camera.width_px,
            height_px: self.view.camera.height_px,
        }
    }

    /// Renders the block whose first pixel is (x, y); both are multiples of [`BLOCK`] and may be negative.
    pub(crate) fn block(&self, x_px: i64, y_px: i64) -> Block {
        let rays = Rays::new(&self.view, x_px, y_px);
        let nearby = self.nearby(&rays);
        let mut out = Block {
            color: [[0.0; 3]; BLOCK * BLOCK],
            depth_mm: [0.0; BLOCK * BLOCK],
        };
        if self.plain(&rays, &nearby, &mut out) {
            return out;
        }
        // First look: what each pixel's centre meets, with one pixel around to see where surfaces end.
        const WIDE: usize = BLOCK + 2;
        let nothing = Hit {
            height: 0.0,
            at: [0.0; 2],
            layer: usize::MAX,
            part: Part::Nothing,
        };
        let mut hits = [nothing; WIDE * WIDE];
        for (i, hit) in hits.iter_mut().enumerate() {
            let (x, y) = ((i % WIDE) as f32 - 1.0, (i / WIDE) as f32 - 1.0);
            *hit = self.meet(&nearby, &rays.at(x, y).0);
        }
        let mut heights = (f32::MAX, f32::MIN);
        for hit in &hits {
            heights = (heights.0.min(hit.height), heights.1.max(hit.height));
        }
        // sheets seen in this block: their own grooves are not in their shadow
        let mut seen: Vec<usize> = Vec::new();
        for hit in &hits {
            if matches!(hit.part, Part::Top | Part::Wall) && !seen.contains(&hit.layer) {
                seen.push(hit.layer);
            }
        }
        let shade = self.shade(&rays, heights, &seen, !nearby.spots.is_empty());
        for y in 0..BLOCK {
            for x in 0..BLOCK {
                let i = (y + 1) * WIDE + x + 1;
                let hit = &hits[i];
                let (ray, t0, dt) = rays.at(x as f32, y as f32);
                let on_head = nearby.spots.iter().any(|(spot, _)| {
                    let p = ray.at_height(spot.placed.height_mm as f32);
                    let (dx, dy) = (p[0] - spot.placed.at_mm[0] as f32, p[1] - spot.placed.at_mm[1] as f32);
                    let reach = 0.58 * spot.placed.item.diameter_mm as f32 + 0.8;
                    dx * dx + dy * dy < reach * reach
                });
                let edge = || {
                    [i - 1, i + 1, i - WIDE, i + WIDE]
                        .iter()
                        .any(|&j| !hits[j].same_surface(hit) || (hits[j].height - hit.height).abs() > 1.5)
                };
                let samples = if on_head {
                    3
                } else if edge() {
                    2
                } else {
                    1
                };
                let mut sum = [0.0f32; 3];
                let mut depth = 0.0;
                for sy in 0..samples {
                    for sx in 0..samples {
                        let offset = |s: usize| (s as f32 + 0.5) / samples as f32 - 0.5;
                        let (color, height) = if samples == 1 {
                            self.color(&nearby, &shade, &ray, *hit)
                        } else {
                            let ray = rays.at(x as f32 + offset(sx), y as f32 + offset(sy)).0;
                            self.color(&nearby, &shade, &ray, self.meet(&nearby, &ray))
                        };
                        for k in 0..3 {
                            sum[k] += color[k];
                        }
                        depth += t0 - height * dt;
                    }
                }
                let scale = 1.0 / (samples * samples) as f32;
                out.color[y * BLOCK + x] = sum.map(|v| v * scale);
                out.depth_mm[y * BLOCK + x] = depth * scale;
            }
        }
        out
    }

    /// Renders a block that shows nothing but the middle of one flat sheet: light changes slowly there, so it is worked out
    /// at a few nodes only. False, and nothing done, if the block is not like that.
    fn plain(&self, rays: &Rays, nearby: &Nearby, out: &mut Block) -> bool {
        let [near] = nearby.layers.as_slice() else { return false };
        let simple = near.inside && near.cutouts.is_empty() && near.is_flat();
        if !simple || !nearby.segments.is_empty() || !nearby.spots.is_empty() {
            return false;
        }
        let layer = near.layer;
        let place = |x: f32, y: f32| {
            let (ray, t0, dt) = rays.at(x, y);
            let height = layer.top_mm + near.rise(ray.at_height(layer.top_mm));
            (ray, ray.at_height(height), height, t0 - height * dt)
        };
        let last = (BLOCK - 1) as f32;
        let corners = [(0.0, 0.0), (last, 0.0), (0.0, last), (last, last)].map(|(x, y)| place(x, y));
        let mut heights = (f32::MAX, f32::MIN);
        for (_, _, h, _) in &corners {
            heights = (heights.0.min(*h), heights.1.max(*h));
        }
        let shade = self.shade(rays, heights, &[near.index], false);
        // Shadows may cross the block if their borders are wider than the distance between nodes.
        let across = {
            let (a, b) = (corners[0].1, corners[3].1);
            (a[0] - b[0]).hypot(a[1] - b[1])
        };
        let even = |k: usize| {
            let (share, casters) = &shade.lights[k];
            let softness = self.lighting.lights[k]
                .at([corners[0].1[0], corners[0].1[1], heights.0])
                .softness;
            let wide = |above: f32| softness * above > 0.7 * across;
            let sheets = casters.iter().all(|c| {
                let above = c.layer.top_mm - heights.1;
                c.index == near.index || wide(above - c.layer.wall_mm.min(0.5 * above))
            });
            let cords = shade.segments[k]
                .iter()
                .all(|&(t, _)| wide(self.tubes[t].heights.0 - heights.1));
            *share <= 0.0 || sheets && cords
        };
        let nodes = if (0..shade.lights.len()).all(even) {
            2
        } else if layer.top_mm < BEHIND_MM {
            6 // out of focus behind the face
        } else {
            return false;
        };
        let normal = unit([-near.slow.slope[0], -near.slow.slope[1], 1.0]);
        let metal = layer.paint.metallic() > 0.0 || !near.decals.is_empty();
        // light given off at each node by black and grey, matt and metal: linear in both between
        let step = last / (nodes - 1) as f32;
        let count = self.lighting.lights.len().min(8);
        let mut lights = [[[0.0f32; 3]; 4]; 36];
        for (node, light) in lights.iter_mut().take(nodes * nodes).enumerate() {
            let (ray, p, height, _) = place((node % nodes) as f32 * step, (node / nodes) as f32 * step);
            let view = unit([ray.slope[0], ray.slope[1], 1.0]);
            let hit = Hit {
                height,
                at: p,
                layer: near.index,
                part: Part::Top,
            };
            let point = [p[0], p[1], height];
            let open = self.openness(&shade, &hit, point);
            let mut visible = [1.0f32; 8];
            for (k, (light, seen)) in self.lighting.lights.iter().zip(&mut visible).enumerate() {
                let incoming = light.at(point);
                *seen = self.lit(&shade, k, &hit, point, incoming.toward, incoming.softness);
            }
            *light = [(0.0, 0.0), (0.5, 0.0), (0.0, 1.0), (0.5, 1.0)].map(|(albedo, metallic)| {
                if metallic > 0.0 && !metal {
                    return [0.0; 3];
                }
                let material = Material {
                    albedo: [albedo; 3],
                    roughness: layer.paint.roughness,
                    metallic,
                };
                self.lighting
                    .radiance(&material, normal, view, &visible[..count], open, point)
            });
        }
        for y in 0..BLOCK {
            let gy = y as f32 / step;
            let row = (gy as usize).min(nodes - 2);
            let fy = gy - row as f32;
            let mut columns = [[[0.0f32; 3]; 4]; 6];
            for (c, column) in columns.iter_mut().take(nodes).enumerate() {
                let (above, below) = (&lights[row * nodes + c], &lights[(row + 1) * nodes + c]);
                *column = std::array::from_fn(|m| std::array::from_fn(|k| lerp(above[m][k], below[m][k], fy)));
            }
            for x in 0..BLOCK {
                let gx = x as f32 / step;
                let column = (gx as usize).min(nodes - 2);
                let fx = gx - column as f32;
                let (left, right) = (&columns[column], &columns[column + 1]);
                let (_, p, _, depth) = place(x as f32, y as f32);
                let mut material = layer.paint.at(p, 20.0);
                for decal in &near.decals {
                    decal.lay(p, &mut material);
                }
                out.color[y * BLOCK + x] = std::array::from_fn(|k| {
                    let light = |m: usize| lerp(left[m][k], right[m][k], fx);
                    let shine = |m: usize| light(m) + 2.0 * material.albedo[k] * (light(m + 1) - light(m));
                    if metal {
                        lerp(shine(0), shine(2), material.metallic)
                    } else {
                        shine(0)
                    }
                });
                out.depth_mm[y * BLOCK + x] = depth;
            }
        }
        true
    }

    fn nearby(&self, rays: &Rays) -> Nearby<'_> {
        self.nearby_rays(
            [(-1.0, -1.0), (17.0, -1.0), (-1.0, 17.0), (17.0, 17.0)].map(|(x, y)| rays.at(x, y).0),
            true,
        )
    }

    fn nearby_rays(&self, corners: [Ray; 4], items: bool) -> Nearby<'_> {
        let seen =
            |low: f32, high: f32| Bounds::of_points(corners.iter().flat_map(|r| [r.at_height(low), r.at_height(high)]));
        let mut layers = Vec::new();
        for (index, layer) in self.layers.iter().enumerate() {
            let here = seen(layer.top_mm - layer.wall_mm.min(600.0) - 3.0, layer.top_mm + 12.0);
            if !layer.bounds.meets(&here) {
                continue;
            }
            let at_top = seen(layer.top_mm - layer.sunk_mm - 0.5, layer.top_mm + layer.raised_mm + 0.5);
            let (center, half) = at_top.middle();
            let outside = layer.shape.distance(center);
            // the outline and openings count down to the foot of their walls
            let (wide, wide_half) = here.middle();
            if layer.shape.distance(wide) > wide_half {
                continue;
            }
            let cutouts: Vec<_> = layer
                .cutouts
                .iter()
                .filter(|c| c.bounds.meets(&at_top) && c.shape.distance(center) < half)
                .collect();
            let mut slow = Slow {
                center,
                ..Slow::default()
            };
            let mut bumps = Vec::new();
            for bump in &layer.bumps {
                if !bump.bounds().meets(&at_top) {
                    continue;
                }
                if let Some((height, slope)) = bump.slow_at(center) {
                    slow.height += height;
                    slow.slope[0] += slope[0];
                    slow.slope[1] += slope[1];
                } else if !bump.is_nothing_within(center, half) {
                    bumps.push(bump);
                }
            }
            let decals = layer.decals.iter().filter(|d| d.bounds().meets(&at_top));
            let inside = outside < -half;
            layers.push(Near {
                index,
                layer,
                cutouts,
                bumps,
                decals: decals.collect(),
                inside,
                edge_mm: if outside < -(half + layer.edge_mm) {
                    0.0
                } else {
                    layer.edge_mm
                },
                slow,
            });
            // nothing below a closed sheet can be seen
            if let Some(last) = layers.last()
                && last.inside
                && last.cutouts.is_empty()
            {
                break;
            }
        }
        let mut segments = Vec::new();
        for (t, tube) in self.tubes.iter().enumerate() {
            let (low, high) = tube.heights;
            if !tube.bounds.meets(&seen(low, high)) {
                continue;
            }
            for (s, pair) in tube.points.windows(2).enumerate() {
                let here = seen(
                    pair[0][2].min(pair[1][2]) - tube.radius,
                    pair[0][2].max(pair[1][2]) + tube.radius,
                );
                let bounds = Bounds::of_points(pair.iter().map(|p| [p[0], p[1]]));
                if bounds.grown(tube.radius + 0.2).meets(&here) {
                    segments.push((t, s));
                }
            }
        }
        let spots = self
            .spots
            .iter()
            .filter(|spot| {
                if !items {
                    return false;
                }
                let h = spot.placed.height_mm as f32;
                spot.bounds.meets(&seen(h - 8.0, h + 8.0))
            })
            .map(|spot| (spot, self.relief(spot)))
            .collect();
        Nearby {
            layers,
            segments,
            spots,
        }
    }

    /// What keeps light from the places of a block that lie between two heights.
    fn shade(&self, rays: &Rays, heights: (f32, f32), seen: &[usize], items: bool) -> Shade<'_> {
        let (low, high) = if items {
            (heights.0 - 6.0, heights.1 + 8.0)
        } else {
            (heights.0 - 0.3, heights.1 + 0.3)
        };
        let mid = 0.5 * (low + high);
        let corners = [(-1.0, -1.0), (17.0, -1.0), (-1.0, 17.0), (17.0, 17.0)].map(|(x, y)| rays.at(x, y).0);
        let here = Bounds::of_points(corners.iter().flat_map(|r| [r.at_height(low), r.at_height(high)]));
        let (center, half) = here.middle();
        let play = 0.5 * (high - low);
        let caster = |index: usize, region: &Bounds| {
            let layer = &self.layers[index];
            Caster {
                index,
                layer,
                cutouts: layer.cutouts.iter().filter(|c| c.bounds.meets(region)).collect(),
            }
        };
        let higher = self.layers.iter().take_while(|l| l.top_mm > low + 0.05);
        let mut lights = Vec::new();
        let mut segments = Vec::new();
        for light in &self.lighting.lights {
            let incoming = light.at([center[0], center[1], mid]);
            let rise = incoming.toward[2].max(0.05);
            let along = [incoming.toward[0] / rise, incoming.toward[1] / rise];
            let run = along[0].hypot(along[1]);
            let mut share = 1.0;
            let mut casters = Vec::new();
            for (index, layer) in higher.clone().enumerate() {
                let above = (layer.top_mm - mid).max(0.0);
                let foot = (above - layer.wall_mm).max(0.0);
                let far = [center[0] + above * along[0], center[1] + above * along[1]];
                let near = [center[0] + foot * along[0], center[1] + foot * along[1]];
                let width = incoming.softness * (above + play) + 0.3 + half + play * run + 0.02 * above;
                let region = Bounds::of_points([far, near]).grown(width);
                if !layer.bounds.meets(&region) {
                    continue;
                }
                // wires whose shadows are wider than the gaps between them
                if let Some((gap, part)) = layer.shape.wires()
                    && incoming.softness * (layer.top_mm - high) > 0.4 * gap
                {
                    if layer.bounds.grown(-width).meets(&region) {
                        share *= 1.0 - part.min(0.7);
                    }
                    continue;
                }
                let reach = 0.5 * (above - foot) * run;
                let between = [0.5 * (far[0] + near[0]), 0.5 * (far[1] + near[1])];
                if layer.shape.distance(between) > width + reach {
                    continue;
                }
                let caster = caster(index, &region);
                // wholly in the umbra; never for what may be the sheet itself
                if layer.top_mm > high + 0.5 && !seen.contains(&index) && caster.solid_distance(far) < -width {
                    share = 0.0;
                    break;
                }
                casters.push(caster);
            }
            let mut cords = Vec::new();
            if share > 0.0 {
                for (t, tube) in self.tubes.iter().enumerate() {
                    let above = (tube.heights.1 - low).max(0.0);
                    if !tube
                        .bounds
                        .grown(half + above * (run + incoming.softness) + 1.0)
                        .meets(&here)
                    {
                        continue;
                    }
                    for (s, pair) in tube.points.windows(2).enumerate() {
                        let level = pair[0][2].max(pair[1][2]) - mid;
                        if level < -play {
                            continue;
                        }
                        let far = [center[0] + level * along[0], center[1] + level * along[1]];
                        let spread = (pair[0][2] - pair[1][2]).abs() + play;
                        let width = incoming.softness * level.max(0.0) + 0.5 + half + spread * run + tube.radius;
                        let bounds = Bounds::of_points(pair.iter().map(|p| [p[0], p[1]]));
                        if bounds.grown(width).meets(&Bounds::around(far, [0.0; 2])) {
                            cords.push((t, s));
                        }
                    }
                }
            }
            lights.push((share, casters));
            segments.push(cords);
        }
        let mut open = Vec::new();
        for (index, layer) in higher.enumerate() {
            let above = (layer.top_mm - low).max(0.0);
            if above < 0.4 {
                break;
            }
            // beyond this what is hidden falls below a hundredth
            let reach = 4.0 * (0.45 * above.min(120.0) + 0.2) + half;
            if layer.bounds.grown(reach).meets(&here) && layer.shape.distance(center) < reach {
                open.push(caster(index, &here.grown(reach)));
            }
        }
        Shade { lights, open, segments }
    }

    /// The first sheet, wall or tube that a ray meets.
    fn meet(&self, nearby: &Nearby, ray: &Ray) -> Hit {
        let mut best = Hit {
            height: FLOOR_MM,
            at: ray.at_height(FLOOR_MM),
            layer: usize::MAX,
            part: Part::Nothing,
        };
        for &(t, s) in &nearby.segments {
            let tube = &self.tubes[t];
            let (a, b) = (tube.points[s], tube.points[s + 1]);
            let mut foot = segment_foot(a, b, ray.at_height(0.5 * (a[2] + b[2])));
            foot = segment_foot(a, b, ray.at_height(foot.height));
            if foot.distance < tube.radius {
                let height = foot.height + (tube.radius * tube.radius - foot.distance * foot.distance).sqrt();
                if height > best.height {
                    best = Hit {
                        height,
                        at: ray.at_height(height),
                        layer: t,
                        part: Part::Tube,
                    };
                }
            }
        }
        for near in &nearby.layers {
            let layer = near.layer;
            // Layers come from the highest down.
            if best.height >= layer.top_mm + 10.0 {
                break;
            }
            let mut height = layer.top_mm;
            let mut p = ray.at_height(height);
            if !near.inside && layer.shape.distance(p) > 0.0 {
                if layer.wall_mm <= 0.0 {
                    continue;
                }
                let low = height - layer.wall_mm;
                if layer.shape.distance(ray.at_height(low)) < 0.0
                    && let Some(h) = crossing(height, low, |h| layer.shape.distance(ray.at_height(h)))
                    && h > best.height
                {
                    best = Hit {
                        height: h,
                        at: ray.at_height(h),
                        layer: near.index,
                        part: Part::Wall,
                    };
                }
                continue;
            }
            let mut open = false;
            for (c, cutout) in near.cutouts.iter().enumerate() {
                if cutout.shape.distance(p) < 0.0 {
                    open = true;
                    let low = height - cutout.wall_mm;
                    if cutout.shape.distance(ray.at_height(low)) > 0.0
                        && let Some(h) = crossing(height, low, |h| -cutout.shape.distance(ray.at_height(h)))
                        && h > best.height
                    {
                        best = Hit {
                            height: h,
                            at: ray.at_height(h),
                            layer: near.index,
                            part: Part::Cut(c),
                        };
                    }
                    break;
                }
            }
            if open {
                continue;
            }
            let looks = if near.is_flat() { 1 } else { 2 };
            for _ in 0..looks {
                height = layer.top_mm + near.rise(p);
                p = ray.at_height(height);
            }
            if height > best.height {
                best = Hit {
                    height,
                    at: p,
                    layer: near.index,
                    part: Part::Top,
                };
            }
        }
        best
    }

    /// Radiance along a ray whose first sheet is known, and the height at which it ends.
    fn color(&self, nearby: &Nearby, shade: &Shade, ray: &Ray, hit: Hit) -> ([f32; 3], f32) {
        let view = unit([ray.slope[0], ray.slope[1], 1.0]);
        let mut point = [hit.at[0], hit.at[1], hit.height];
        let (mut material, mut normal) = self.surface(nearby, &hit);
        let mut open = 1.0;
        let mut on_spot = None;
        let mut above_sheet = 0.0;
        for (k, (spot, relief)) in nearby.spots.iter().enumerate() {
            let base = spot.placed.height_mm as f32;
            let (x, y) = (spot.placed.at_mm[0] as f32, spot.placed.at_mm[1] as f32);
            let p = ray.at_height(base);
            if !relief.contains(p[0] - x, p[1] - y) {
                continue;
            }
            let start = [p[0] - x, p[1] - y, 0.0];
            let Some(q) = relief.march(start, [-ray.slope[0], -ray.slope[1], -1.0]) else {
                continue;
            };
            let (own, cover) = relief.material(q[0], q[1]);
            let mounted = hit.layer == spot.layer && hit.part == Part::Top;
            if !(mounted || base + q[2] > hit.height - 0.05 && (q[2].abs() > 0.03 || cover > 0.05)) {
                continue;
            }
            if base + q[2] < hit.height - 0.3 && !mounted {
                continue;
            }
            material = blend(&material, &own, cover);
            open = relief.open(q[0], q[1]);
            let tilt = relief.normal(q[0], q[1]);
            if mounted && q[2].abs() < 0.25 && !solid_at(relief, q[0], q[1]) {
                // dirt and wear on the sheet follow the sheet's own slopes
                let (a, b) = (tilt[2].max(0.05), normal[2].max(0.05));
                normal = unit([tilt[0] / a + normal[0] / b, tilt[1] / a + normal[1] / b, 1.0]);
                point[2] += q[2];
            } else {
                normal = tilt;
                point = [q[0] + x, q[1] + y, base + q[2]];
            }
            on_spot = Some(k);
            above_sheet = q[2];
            break;
        }
        open *= self.openness(shade, &hit, point);
        let mut visible = [1.0f32; 8];
        for (index, (light, seen)) in self.lighting.lights.iter().zip(&mut visible).enumerate() {
            let incoming = light.at(point);
            if dot(incoming.toward, normal) < -0.5 {
                *seen = 0.0;
                continue;
            }
            *seen = self.lit(shade, index, &hit, point, incoming.toward, incoming.softness);
            for (k, (spot, relief)) in nearby.spots.iter().enumerate() {
                if *seen <= 0.0 {
                    break;
                }
                if on_spot.is_some_and(|s| s != k) {
                    continue;
                }
                let mut local = [
                    point[0] - spot.placed.at_mm[0] as f32,
                    point[1] - spot.placed.at_mm[1] as f32,
                    point[2] - spot.placed.height_mm as f32,
                ];
                if hit.layer == spot.layer && hit.part == Part::Top {
                    // the relief knows a flat sheet: heights count from the real one, seats and ribs included
                    local[2] = above_sheet;
                } else if local[2] < -1.0 {
                    continue;
                }
                if in_reach(spot, relief, local, &incoming) {
                    *seen *= relief.visibility(local, incoming.toward, incoming.softness);
                }
            }
        }
        let count = self.lighting.lights.len().min(8);
        let color = self
            .lighting
            .radiance(&material, normal, view, &visible[..count], open, point);
        (color, point[2])
    }

    /// Material and normal of a sheet, wall or tube.
    fn surface(&self, nearby: &Nearby, hit: &Hit) -> (Material, [f32; 3]) {
        match hit.part {
            Part::Nothing => (
                Material {
                    albedo: [0.05; 3],
                    roughness: 1.0,
                    metallic: 0.0,
                },
                [0.0, 0.0, 1.0],
            ),
            Part::Tube => {
                let tube = &self.tubes[hit.layer];
                let mut best: Option<crate::layer::TubeFoot> = None;
                for &(t, s) in nearby.segments.iter().filter(|(t, _)| *t == hit.layer) {
                    let tube = &self.tubes[t];
                    let foot = segment_foot(tube.points[s], tube.points[s + 1], hit.at);
                    if best.is_none_or(|b| foot.distance < b.distance) {
                        best = Some(foot);
                    }
                }
                let normal = best.map_or([0.0, 0.0, 1.0], |foot| {
                    let side = (foot.distance / tube.radius).min(1.0);
                    [foot.across[0] * side, foot.across[1] * side, (1.0 - side * side).sqrt()]
                });
                (tube.paint.at(hit.at, 20.0), normal)
            }
            Part::Top | Part::Wall | Part::Cut(_) => {
                let layer = &self.layers[hit.layer];
                let Some(near) = nearby.layers.iter().find(|n| n.index == hit.layer) else {
                    return (layer.paint.at(hit.at, 20.0), [0.0, 0.0, 1.0]);
                };
                let slope = |f: &dyn Fn(Xy) -> f32, step: f32| -> Xy {
                    let [x, y] = hit.at;
                    [
                        (f([x + step, y]) - f([x - step, y])) / (2.0 * step),
                        (f([x, y + step]) - f([x, y - step])) / (2.0 * step),
                    ]
                };
                let normal = match hit.part {
                    Part::Wall => {
                        let g = slope(&|p| layer.shape.distance(p), 0.1);
                        unit([g[0], g[1], 0.02])
                    }
                    Part::Cut(c) => {
                        let g = slope(&|p| near.cutouts[c].shape.distance(p), 0.1);
                        unit([-g[0], -g[1], 0.02])
                    }
                    _ if near.is_flat() => unit([-near.slow.slope[0], -near.slow.slope[1], 1.0]),
                    _ => {
                        let g = slope(&|p| near.rise(p), 0.15);
                        unit([-g[0], -g[1], 1.0])
                    }
                };
                let inset = if near.inside && near.edge_mm <= 0.0 && near.cutouts.is_empty() {
                    20.0
                } else {
                    // a rim of a wall is as exposed as that of the sheet
                    let openings = near.cutouts.iter().map(|c| c.shape.distance(hit.at));
                    openings.fold(-layer.shape.distance(hit.at), f32::min).max(0.0)
                };
                // on a wall the texture runs along it and down
                let place = match hit.part {
                    Part::Top => hit.at,
                    _ => [hit.at[0] * normal[1].abs() + hit.at[1] * normal[0].abs(), -hit.height],
                };
                let mut material = layer.paint.at(place, inset);
                if hit.part == Part::Top {
                    for decal in &near.decals {
                        decal.lay(hit.at, &mut material);
                    }
                }
                (material, normal)
            }
        }
    }

    /// Share of the surroundings that reaches a point between higher sheets.
    fn openness(&self, shade: &Shade, hit: &Hit, point: [f32; 3]) -> f32 {
        let mut open = 1.0;
        for caster in &shade.open {
            let above = caster.layer.top_mm - point[2];
            if above < 0.4 || caster.index == hit.layer && matches!(hit.part, Part::Top | Part::Wall) {
                continue;
            }
            let outside = caster.layer.shape.distance([point[0], point[1]]);
            let reach = 0.45 * above.min(120.0) + 0.2;
            if outside >= 0.0 {
                open *= 1.0 - 0.5 * (-outside / reach).exp();
            } else {
                let gap = caster.solid_distance([point[0], point[1]]).max(0.0);
                open *= 1.0 - 0.8 * (-gap / reach).exp();
            }
        }
        open
    }

    /// Share of a light that passes the sheets and tubes above a point.
    fn lit(&self, shade: &Shade, light: usize, hit: &Hit, point: [f32; 3], toward: [f32; 3], softness: f32) -> f32 {
        let (share, casters) = &shade.lights[light];
        if *share <= 0.0 || casters.is_empty() && shade.segments[light].is_empty() {
            return *share;
        }
        let rise = toward[2].max(0.05);
        let along = [toward[0] / rise, toward[1] / rise];
        let mut lit = 1.0f32;
        for caster in casters {
            let above = caster.layer.top_mm - point[2];
            let own = caster.index == hit.layer && hit.part != Part::Tube;
            if above < 0.05 || own && matches!(hit.part, Part::Top | Part::Wall) {
                continue;
            }
            let low = (above - caster.layer.wall_mm).max(0.0);
            let looks = if low < above - 2.0 && !own {
                // close enough together that a tall wall throws one shadow
                3 + ((above - low) * along[0].hypot(along[1]) * 0.03).min(4.0) as usize
            } else {
                1
            };
            for k in 0..looks {
                let s = lerp(above, low, k as f32 / (looks - 1).max(1) as f32);
                let p = [point[0] + s * along[0], point[1] + s * along[1]];
                let d = caster.solid_distance(p);
                let width = softness * s + 0.25;
                lit = lit.min((0.5 + 0.5 * d / width).clamp(0.0, 1.0));
            }
            if lit <= 0.0 {
                return 0.0;
            }
        }
        for &(t, s) in &shade.segments[light] {
            let tube = &self.tubes[t];
            let (a, b) = (tube.points[s], tube.points[s + 1]);
            let mean = 0.5 * (a[2] + b[2]) - point[2];
            if mean < 0.5 * tube.radius || hit.part == Part::Tube && hit.layer == t {
                continue;
            }
            let foot = segment_foot(a, b, [point[0] + mean * along[0], point[1] + mean * along[1]]);
            let above = foot.height - point[2];
            let foot = segment_foot(a, b, [point[0] + above * along[0], point[1] + above * along[1]]);
            let width = softness * above + 0.25;
            // A thin tube hides only its part of a wide light.
            let part = (tube.radius / width).min(1.0);
            let dark = (0.5 - 0.5 * (foot.distance - tube.radius) / width).clamp(0.0, 1.0);
            lit = lit.min(1.0 - part * dark);
        }
        share * lit * lit * (3.0 - 2.0 * lit)
    }
}

/// What lies lower than this is behind the face: no item sits there.
const BEHIND_MM: f32 = -100.0;

/// Below this nothing is drawn, mm.
const FLOOR_MM: f32 = -2500.0;

/// Height between `high` and `low` at which a distance changes from positive to negative, by bisection.
fn crossing(high: f32, low: f32, distance: impl Fn(f32) -> f32) -> Option<f32> {
    let (mut outside, mut inside) = (high, low);
    for _ in 0..12 {
        let mid = 0.5 * (outside + inside);
        if distance(mid) > 0.0 {
            outside = mid;
        } else {
            inside = mid;
        }
    }
    Some(inside)
}

/// Whether an item can throw its shadow on a place near it: on itself, or on the sheet on the side away from the light.
#[inline]
fn in_reach(spot: &Spot, relief: &Relief, local: [f32; 3], light: &Incoming) -> bool {
    let [x, y, z] = local;
    let body = 0.58 * spot.placed.item.diameter_mm as f32 + 0.3;
    let r2 = x * x + y * y;
    if r2 < body * body {
        return true;
    }
    let away = x * light.toward[0] + y * light.toward[1] < 0.2 * body;
    let run = light.toward[0].hypot(light.toward[1]) / light.toward[2].max(0.05) + light.softness;
    let reach = body + (relief.top_mm - z).max(0.0) * run;
    away && r2 < reach * reach
}

/// Whether a place belongs to the item itself rather than to the sheet around it.
fn solid_at(relief: &Relief, x: f32, y: f32) -> bool {
    let cell = |v: f32| ((v + relief.half_mm()) / relief.texel_mm + 0.5).clamp(0.0, (relief.size - 1) as f32) as usize;
    relief.solid[cell(y) * relief.size + cell(x)]
}

fn blend(under: &Material, over: &Material, cover: f32) -> Material {
    Material {
        albedo: std::array::from_fn(|k| lerp(under.albedo[k], over.albedo[k], cover)),
        roughness: lerp(under.roughness, over.roughness, cover),
        metallic: lerp(under.metallic, over.metallic, cover),
    }
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn unit(a: [f32; 3]) -> [f32; 3] {
    let scale = 1.0 / dot(a, a).sqrt().max(1e-9);
    a.map(|v| v * scale)
}

/// The hole that a screw leaves.
fn empty_hole(item: &Item) -> Item {
    Item {
        kind: Kind::Decoy(Decoy::EmptyScrewHole),
        ..item.clone()
    }
}

impl Spot {
    fn new(placed: Placed, layers: &[Layer]) -> Self {
        let at = [placed.at_mm[0] as f32, placed.at_mm[1] as f32];
        let height = placed.height_mm as f32;
        let distance = |l: &Layer| (l.height(at) - height).abs() + 100.0 * l.shape.distance(at).max(0.0);
        let layer = (0..layers.len())
            .min_by(|&a, &b| distance(&layers[a]).total_cmp(&distance(&layers[b])))
            .unwrap_or(0);
        Self {
            bounds: Bounds::around(at, [1.75 * placed.item.diameter_mm as f32 + 4.0; 2]),
            layer,
            placed,
            relief: OnceLock::new(),
        }
    }
}
