//! Outdoor units and their pictures: procedural products, wear, renderer, camera noise, exact truth.

pub mod bake;
pub mod fastener;
mod form;
mod noise;
pub mod relief;
pub mod shade;
mod texture;
mod wear;
