//! Outdoor units and their pictures: procedural products, wear, renderer, camera noise, exact truth.

pub mod bake;
pub mod fastener;
pub mod relief;
pub mod shade;
