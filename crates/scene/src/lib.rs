//! Outdoor units and their pictures: products, wear, renderer, camera, exact truth.
