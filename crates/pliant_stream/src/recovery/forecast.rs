//! Extrapolation of a hand's motion while no data arrives.
//!
//! A parabola is fitted (least squares) to the last 0.4 s and extrapolated. Its velocity fades over
//! 1.5 s and its acceleration over 0.4 s. The window spans several periods of a hand's tremor (8 to
//! 12 Hz) and is short compared with deliberate motion (below 2 Hz). Extrapolating from the last
//! two or three values instead multiplies the tremor, by thirty after twelve ticks.

/// Span of the fit, s.
const WINDOW: f64 = 0.4;
/// Fade time of the velocity, s.
const VELOCITY: f64 = 1.5;
/// Fade time of the acceleration, s.
const ACCELERATION: f64 = 0.4;
/// Values that are extrapolated together: target, reaction and displacement.
pub(crate) const CHANNELS: usize = 9;

/// Settings of the extrapolation for one step size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Forecast {
    window: u64,
    keep_velocity: f64,
    keep_acceleration: f64,
}

impl Forecast {
    /// Creates an extrapolation for steps of `h` seconds.
    pub fn new(h: f64) -> Self {
        Self {
            window: ((WINDOW / h).round() as u64).clamp(4, 96),
            keep_velocity: (-h / VELOCITY).exp(),
            keep_acceleration: (-h / ACCELERATION).exp(),
        }
    }

    /// Length of the fit, ticks.
    pub(crate) fn window(&self) -> u64 {
        self.window
    }

    /// Extrapolates to `ahead` ticks after the newest sample. `samples` holds (ticks before the
    /// newest, values), with the newest first. Returns `None` without samples.
    pub(crate) fn go_on<const N: usize>(&self, samples: &[(u64, [f64; N])], ahead: u64) -> Option<[f64; N]> {
        let (_, newest) = samples.first()?;
        if samples.len() < 4 {
            let Some((back, before)) = samples.get(1) else { return Some(*newest) };
            let (s, _) = self.paths(ahead);
            let slope = |k: usize| (newest[k] - before[k]) / (*back).max(1) as f64;
            return Some(std::array::from_fn(|k| newest[k] + s * slope(k)));
        }
        // Normal equations of a parabola in x = -back / window, which lies in [-1, 0].
        let scale = self.window as f64;
        let mut m = [0.0; 5];
        let mut right = [[0.0; N]; 3];
        for (back, values) in samples {
            let x = -(*back as f64) / scale;
            let mut power = 1.0;
            for (d, m) in m.iter_mut().enumerate() {
                *m += power;
                if d < 3 {
                    for (r, v) in right[d].iter_mut().zip(values) {
                        *r += power * v;
                    }
                }
                power *= x;
            }
        }
        let matrix = nalgebra::Matrix3::new(m[0], m[1], m[2], m[1], m[2], m[3], m[2], m[3], m[4]);
        let inverse = matrix.try_inverse()?;
        let (s, c) = self.paths(ahead);
        // The result is value + s * velocity (per tick) + c * acceleration (per tick squared).
        let weights = nalgebra::RowVector3::new(1.0, s / scale, 2.0 * c / (scale * scale)) * inverse;
        let mut out = [0.0; N];
        for (w, right) in weights.iter().zip(&right) {
            for (o, r) in out.iter_mut().zip(right) {
                *o += w * r;
            }
        }
        out.iter().all(|x| x.is_finite()).then_some(out)
    }

    /// Displacement after `ahead` ticks from a unit velocity and from a unit acceleration, both
    /// fading.
    fn paths(&self, ahead: u64) -> (f64, f64) {
        let (mut s, mut c, mut gained) = (0.0, 0.0, 0.0);
        let (mut velocity, mut acceleration) = (1.0, 1.0);
        for _ in 0..ahead.min(200) {
            velocity *= self.keep_velocity;
            gained += acceleration;
            acceleration *= self.keep_acceleration;
            s += velocity;
            c += velocity * (gained - 0.5);
        }
        (s, c)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(count: u64, f: impl Fn(f64) -> f64) -> Vec<(u64, [f64; CHANNELS])> {
        (0..count).map(|back| (back, [f(-(back as f64)); CHANNELS])).collect()
    }

    #[test]
    fn a_parabola_is_followed_and_fades() {
        let forecast = Forecast::new(0.025);
        let f = |t: f64| 1.0 + 0.02 * t + 0.001 * t * t;
        let got = forecast.go_on(&samples(16, f), 1).unwrap()[0];
        // After one tick the velocity of 0.021 has faded by 1.7 %.
        assert!((got - f(1.0)).abs() < 5e-4, "{got} and {}", f(1.0));
        let far = forecast.go_on(&samples(16, f), 200).unwrap()[4];
        // 0.02 per tick fading over 60 ticks gives 1.2. 0.002 per tick^2 fading over 16, then over
        // 60 ticks, gives 1.9. A longer extrapolation adds no more.
        assert!((2.0..5.0).contains(&far), "{far}");
        let further = forecast.go_on(&samples(16, f), 4000).unwrap()[4];
        assert!((further - far).abs() < 0.2, "{far} {further}");
    }

    #[test]
    fn tremor_is_not_multiplied() {
        let forecast = Forecast::new(0.025);
        for phase in 0..40 {
            let f = |t: f64| (std::f64::consts::TAU * 9.3 * 0.025 * t + f64::from(phase) * 0.157).sin();
            let worst =
                (1..=12).map(|n| forecast.go_on(&samples(16, f), n).unwrap()[0].abs()).fold(0.0, f64::max);
            assert!(worst < 2.5, "phase {phase}: a tremor of 1 becomes {worst}");
        }
    }

    #[test]
    fn few_samples_and_gaps_are_enough() {
        let forecast = Forecast::new(0.025);
        assert_eq!(forecast.go_on::<CHANNELS>(&[], 3), None);
        assert_eq!(forecast.go_on(&[(0, [2.0; CHANNELS])], 3), Some([2.0; CHANNELS]));
        let two = forecast.go_on(&[(0, [2.0; CHANNELS]), (2, [1.0; CHANNELS])], 1).unwrap();
        assert!((two[0] - 2.5).abs() < 0.01, "{two:?}");
        let gaps: Vec<_> = samples(16, |t| 3.0 + 0.1 * t).into_iter().filter(|s| s.0 % 3 != 1).collect();
        let got = forecast.go_on(&gaps, 2).unwrap()[8];
        assert!((got - 3.2).abs() < 0.01, "{got}");
    }
}
