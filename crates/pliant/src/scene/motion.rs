//! The position of a scripted hand over time.

use bevy::math::DVec3;

use super::Motion;

impl Motion {
    /// Returns the offset of the hand from where it is held, m, `t` seconds after it took hold.
    ///
    /// `Path` moves smoothly from point to point (`3 s^2 - 2 s^3`).
    pub fn at(&self, t: f64) -> DVec3 {
        let t = if t.is_finite() { t.max(0.0) } else { 0.0 };
        match self {
            Self::Still => DVec3::ZERO,
            Self::Waves { size, hz } => {
                let wave = |axis: usize| size[axis] * (std::f64::consts::TAU * hz[axis] * t).sin();
                DVec3::new(wave(0), wave(1), wave(2))
            }
            Self::Path { points, repeat } => {
                let Some(last) = points.last() else { return DVec3::ZERO };
                let first_lap = t <= last.at;
                let time = if *repeat && !first_lap { t % last.at } else { t };
                let next = points.partition_point(|point| point.at < time);
                let Some(to) = points.get(next) else { return last.to.into() };
                let (from_time, from) = match next.checked_sub(1).and_then(|before| points.get(before)) {
                    Some(before) => (before.at, DVec3::from(before.to)),
                    // A lap begins where the previous lap ended.
                    None if first_lap => (0.0, DVec3::ZERO),
                    None => (0.0, last.to.into()),
                };
                from.lerp(to.to.into(), smooth((time - from_time) / (to.at - from_time)))
            }
        }
    }
}

/// Rises from 0 to 1 with zero velocity at both ends.
pub(super) fn smooth(s: f64) -> f64 {
    let s = if s.is_nan() { 1.0 } else { s.clamp(0.0, 1.0) };
    s * s * (3.0 - 2.0 * s)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::PointEntry;

    #[test]
    fn waves_go_to_and_fro_and_paths_rest_at_their_points() {
        let waves = Motion::Waves { size: [0.1, 0.0, 0.2], hz: [1.0, 1.0, 0.5] };
        assert!(
            waves
                .at(0.25)
                .abs_diff_eq(DVec3::new(0.1, 0.0, 0.2 * (0.25 * std::f64::consts::PI).sin()), 1e-12)
        );
        let point = |at, x| PointEntry { at, to: [x, 0.0, 0.0] };
        let path = |repeat| Motion::Path { points: vec![point(1.0, 0.2), point(3.0, -0.2)], repeat };
        for (t, once, again) in [
            (0.0, 0.0, 0.0),
            (0.5, 0.1, 0.1),
            (1.0, 0.2, 0.2),
            (2.0, 0.0, 0.0),
            (3.0, -0.2, -0.2),
            (3.5, -0.2, 0.0),
            (4.0, -0.2, 0.2),
        ] {
            assert!((path(false).at(t).x - once).abs() < 1e-12, "{t}");
            assert!((path(true).at(t).x - again).abs() < 1e-12, "{t}");
        }
        // At rest at a point, the motion within a millisecond is below a millionth of a meter.
        assert!((path(false).at(1.001).x - 0.2).abs() < 1e-6);
        assert_eq!(path(true).at(f64::NAN), DVec3::ZERO);
        assert_eq!(Motion::Path { points: Vec::new(), repeat: true }.at(1.0), DVec3::ZERO);
    }
}
