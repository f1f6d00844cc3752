//! What earlier looks at a face have told.

use super::{SAME_HEAD, odds};
use crate::capture::Shot;
use crate::config::CellConfig;
use crate::program::FaceId;
use crate::record::{FaceRecord, Found, UnitRecord, Verdict};
use geometry::{Camera, Direction, Pixel};

/// The looks at a face so far, in order, as a new shot of it sees them.
pub(super) struct Earlier<'a> {
    looks: Vec<&'a FaceRecord>,
    shot: &'a Shot,
}

impl<'a> Earlier<'a> {
    pub(super) fn of(unit: &'a UnitRecord, face: &FaceId, shot: &'a Shot) -> Self {
        let looks = unit.faces.iter().filter(|f| f.face == *face).collect();
        Self { looks, shot }
    }

    /// True if a bit was driven at anything on it.
    pub(super) fn touched(&self) -> bool {
        self.looks.iter().any(|f| !f.attempts.is_empty())
    }

    /// The finds of the last look at which pictures alone decided.
    pub(super) fn by_pictures_alone(&self, config: &CellConfig) -> &'a [Found] {
        let last = self.looks.iter().rfind(|f| odds(config, f.purpose) == 1.0);
        last.map_or(&[][..], |f| &f.found)
    }

    /// Places of what was taken for screws, with diameters, px of the shot. They may be holes by now.
    pub(super) fn screws(&self) -> impl Iterator<Item = (Pixel, f64)> {
        let found = self.looks.iter().flat_map(|f| &f.found);
        let screws = found.filter(|f| f.verdict == Verdict::Screw);
        screws.map(|f| (self.place(f), f.diameter_px))
    }

    /// Which way its heads looked together, where they leaned.
    pub(super) fn heads_normal(&self) -> Option<Direction<Camera>> {
        self.looks.iter().rev().find_map(|f| f.plane?.heads_normal)
    }

    /// Whether places around a find that the bit has not met were tried too; `None` if it was met or not tried.
    pub(super) fn not_met(&self, screw: &vision::Screw) -> Option<bool> {
        let is_it = |f: &Found| self.place(f).distance_px(&screw.pixel) < SAME_HEAD * screw.diameter_px;
        let tried = self.looks.iter().flat_map(|f| f.not_met());
        let tried = tried.filter(|(found, _)| is_it(found));
        tried.map(|(_, attempt)| attempt.searched()).reduce(|a, b| a || b)
    }

    fn place(&self, found: &Found) -> Pixel {
        self.shot.to_shot(Pixel::new(found.u_px, found.v_px))
    }
}
