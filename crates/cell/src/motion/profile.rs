//! From rest to rest with limited speed, acceleration and jerk: the double-S profile of seven phases
//! (Biagiotti and Melchiorri 2008, section 3.4).

/// Time from rest to full speed, s: what a GP25 with its driver was taken to need before this profile.
const RISE_S: f64 = 0.3;
/// Part of it over which the acceleration builds up, and again over which it fades, s.
const BLEND_S: f64 = 0.05;

/// What may not be exceeded on a way, in units of the way (rad or mm).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// A second.
    pub speed: f64,
    /// A second, squared.
    pub acceleration: f64,
    /// A second, cubed.
    pub jerk: f64,
}

impl Limits {
    /// Limits with which this speed is reached within 0.3 s, of which the acceleration takes 0.05 s to build up.
    pub fn of_speed(speed: f64) -> Self {
        let acceleration = speed / (RISE_S - BLEND_S);
        Self {
            speed,
            acceleration,
            jerk: acceleration / BLEND_S,
        }
    }

    /// The same limits on a way that is measured in another unit, so many of the old one long each.
    #[must_use]
    pub fn per(&self, unit: f64) -> Self {
        Self {
            speed: self.speed / unit,
            acceleration: self.acceleration / unit,
            jerk: self.jerk / unit,
        }
    }

    /// Times of blending and of the whole rise until a speed is reached, s.
    fn rise_s(&self, speed: f64) -> (f64, f64) {
        let blend_s = self.acceleration / self.jerk;
        if speed >= self.acceleration * blend_s {
            (blend_s, blend_s + speed / self.acceleration)
        } else {
            let blend_s = (speed / self.jerk).sqrt();
            (blend_s, 2.0 * blend_s)
        }
    }

    /// Highest speed that a way allows: it takes half of the way to reach it.
    fn peak(&self, way: f64) -> f64 {
        let blend_s = self.acceleration / self.jerk;
        let peak = if way >= 2.0 * self.acceleration * blend_s.powi(2) {
            0.5 * self.acceleration * ((blend_s.powi(2) + 4.0 * way / self.acceleration).sqrt() - blend_s)
        } else {
            self.jerk * (0.5 * way / self.jerk).cbrt().powi(2)
        };
        peak.min(self.speed)
    }
}

/// How far along a way one is, and when: from rest to rest in the shortest time that the limits allow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Profile {
    way: f64,
    peak: f64,
    jerk: f64,
    blend_s: f64,
    rise_s: f64,
    duration_s: f64,
}

impl Profile {
    /// The fastest profile over a way within limits (all of them above zero); no way takes no time.
    pub fn new(way: f64, limits: Limits) -> Self {
        let way = way.max(0.0);
        let peak = limits.peak(way);
        let (blend_s, rise_s) = limits.rise_s(peak);
        let duration_s = if way > 0.0 {
            (way / peak + rise_s).max(2.0 * rise_s)
        } else {
            0.0
        };
        Self {
            way,
            peak,
            jerk: limits.jerk,
            blend_s,
            rise_s,
            duration_s,
        }
    }

    /// How long it takes, s.
    pub fn duration_s(&self) -> f64 {
        self.duration_s
    }

    /// How much of the way lies behind one at a time; before the beginning none, after the end all.
    pub fn at(&self, t_s: f64) -> f64 {
        if t_s <= 0.0 {
            0.0
        } else if t_s >= self.duration_s {
            self.way
        } else if t_s <= 0.5 * self.duration_s {
            self.begun(t_s)
        } else {
            // the end is the beginning backwards
            self.way - self.begun(self.duration_s - t_s)
        }
    }

    /// The first half.
    fn begun(&self, t_s: f64) -> f64 {
        let (blend_s, left_s) = (self.blend_s, self.rise_s - t_s);
        let acceleration = self.jerk * blend_s;
        if t_s < blend_s {
            self.jerk * t_s.powi(3) / 6.0
        } else if left_s > blend_s {
            acceleration * (0.5 * t_s * (t_s - blend_s) + blend_s.powi(2) / 6.0)
        } else {
            // from here on the speed is the peak, but for what the fading acceleration still lacks
            let lacking = self.jerk * left_s.max(0.0).powi(3) / 6.0;
            self.peak * (t_s - 0.5 * self.rise_s) + lacking
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Speed, acceleration and jerk at their largest, by differences.
    fn largest(profile: &Profile, steps: u32) -> [f64; 3] {
        let h = profile.duration_s() / f64::from(steps);
        let s = |k: u32| profile.at(f64::from(k) * h);
        let mut most = [0.0f64; 3];
        for k in 0..steps - 2 {
            let [a, b, c, d] = [s(k), s(k + 1), s(k + 2), s(k + 3)];
            most[0] = most[0].max((b - a).abs() / h);
            most[1] = most[1].max((c - 2.0 * b + a).abs() / h.powi(2));
            most[2] = most[2].max((d - 3.0 * c + 3.0 * b - a).abs() / h.powi(3));
        }
        most
    }

    proptest! {
        #[test]
        fn no_limit_is_exceeded(way in 1e-3..10.0f64, speed in 0.1..10.0f64, rise in 0.05..1.0f64, blend in 0.02..0.5f64) {
            let acceleration = speed / rise;
            let limits = Limits { speed, acceleration, jerk: acceleration / blend };
            let profile = Profile::new(way, limits);
            let [v, a, j] = largest(&profile, 500);
            // differences over a way lose digits: the more, the higher the derivative
            prop_assert!(v <= speed * (1.0 + 1e-9) && a <= limits.acceleration * (1.0 + 1e-6), "{v} {a} {limits:?}");
            prop_assert!(j <= limits.jerk * (1.0 + 1e-3), "{j} {limits:?}");
            // what is limited is reached, where differences are fine enough to see it: it could not be faster
            prop_assert!(j > 0.98 * limits.jerk || profile.blend_s < 0.01 * profile.duration_s(), "{j} {limits:?}");
            prop_assert!(v > 0.98 * speed || profile.duration_s() <= 2.0 * profile.rise_s * (1.0 + 1e-9));
        }

        #[test]
        fn it_ends_where_it_should_and_is_symmetric(way in 0.0..10.0f64, speed in 0.1..10.0f64, share in 0.0..1.0f64) {
            let profile = Profile::new(way, Limits::of_speed(speed));
            prop_assert_eq!(profile.at(profile.duration_s()), way);
            prop_assert_eq!((profile.at(-1.0), profile.at(0.0)), (0.0, 0.0));
            let t_s = share * profile.duration_s();
            let both = profile.at(t_s) + profile.at(profile.duration_s() - t_s);
            prop_assert!((both - way).abs() < 1e-9, "{both} of {way}");
        }

        #[test]
        fn a_longer_way_takes_longer(way in 0.0..5.0f64, more in 1e-6..5.0f64, speed in 0.1..10.0f64) {
            let time_s = |way| Profile::new(way, Limits::of_speed(speed)).duration_s();
            prop_assert!(time_s(way + more) > time_s(way));
        }
    }

    #[test]
    fn long_ways_take_what_a_ramp_of_speed_took() {
        // the times of the simulated cell were measured with a trapezoid of 0.3 s
        let ramp_s = |way: f64, speed: f64| {
            if way >= speed * RISE_S {
                way / speed + RISE_S
            } else {
                2.0 * (way * RISE_S / speed).sqrt()
            }
        };
        for (way, least_s, most_s) in [
            (210.0, 0.0, 1e-9),
            (63.0, 0.0, 1e-9),
            (30.0, 0.0, 0.02),
            (6.0, 0.03, 0.05),
        ] {
            let longer_s = Profile::new(way, Limits::of_speed(210.0)).duration_s() - ramp_s(way, 210.0);
            assert!(
                (least_s - 1e-9..=most_s).contains(&longer_s),
                "{way}: {longer_s} s longer"
            );
        }
    }
}
