//! The motion of a body's most compliant point over the last seconds, and its spectrum.

use std::{collections::VecDeque, f64::consts::TAU};

use pliant_modal::ModalModel;

/// Number of samples in the window of a spectrum: 6.4 s at 40 ticks per second.
const WINDOW: usize = 256;

/// The displacement of one point of a body, tick by tick.
#[derive(Debug)]
pub(crate) struct ModalMotion {
    /// The vertex that the modes move most, each mode weighted as a load on the vertex excites it:
    /// `max sum phi^2 / omega^2`.
    vertex: u32,
    points: VecDeque<[f64; 3]>,
    /// Tick and simulated time of the newest sample.
    newest: Option<(u64, f64)>,
    /// Length of a tick, s.
    tick: f64,
}

impl ModalMotion {
    pub fn new(model: &ModalModel) -> Self {
        let looseness = |vertex: u32| -> f64 {
            let of = |mode: usize, omega: f64| -> f64 {
                (0..3)
                    .map(|axis| (f64::from(model.displacement_row(vertex, axis, mode)) / omega).powi(2))
                    .sum()
            };
            model.omega().iter().enumerate().map(|(mode, &omega)| of(mode, omega)).sum()
        };
        let vertices = u32::try_from(model.surface().positions().len()).unwrap_or(u32::MAX);
        let loosest = (0..vertices).max_by(|&a, &b| looseness(a).total_cmp(&looseness(b)));
        Self { vertex: loosest.unwrap_or(0), points: VecDeque::new(), newest: None, tick: 0.0 }
    }

    /// Adds the point's displacement at modal coordinates `q` and simulated time `time` (s). For
    /// missing ticks the body is taken as unmoved.
    pub fn push(&mut self, model: &ModalModel, q: &[f32], tick: u64, time: f64) {
        let passed = match self.newest {
            Some((before, then)) if tick > before && time > then => {
                self.tick = (time - then) / (tick - before) as f64;
                (tick - before).min(WINDOW as u64) as usize
            }
            _ => {
                self.points.clear();
                0
            }
        };
        self.newest = Some((tick, time));
        if let Some(&stood) = self.points.back() {
            self.points.extend(std::iter::repeat_n(stood, passed.saturating_sub(1)));
        }
        // Warping is left out. It bends the path of a point, does not change its frequencies, and
        // needs rotations that nothing else here needs.
        let along = |axis: usize| {
            let modes = q.iter().enumerate();
            modes.map(|(mode, &q)| f64::from(q * model.displacement_row(self.vertex, axis, mode))).sum()
        };
        self.points.push_back([along(0), along(1), along(2)]);
        while self.points.len() > WINDOW {
            self.points.pop_front();
        }
    }

    /// Returns the frequencies (Hz, from 0 to half the tick rate) and the amplitude at each (m of
    /// the model) once the window is full.
    ///
    /// The mean is removed, a Hann window is applied, and the three axes are combined as the root
    /// of the sum of their squares. A sine of amplitude `a` between two frequencies gives at least
    /// 0.85 `a`.
    pub fn spectrum(&self) -> Option<(Vec<f64>, Vec<f64>)> {
        let n = self.points.len();
        if n < WINDOW || self.tick <= 0.0 {
            return None;
        }
        let mean: [f64; 3] =
            std::array::from_fn(|k| self.points.iter().map(|p| p[k]).sum::<f64>() / n as f64);
        let angle = |i: usize| TAU * (i % n) as f64 / n as f64;
        let (cos, sin): (Vec<f64>, Vec<f64>) = (0..n).map(|i| (angle(i).cos(), angle(i).sin())).unzip();
        let window = |i: usize| 0.5 * (1.0 - cos[i]);
        let windowed: Vec<[f64; 3]> = self
            .points
            .iter()
            .enumerate()
            .map(|(i, p)| std::array::from_fn(|k| window(i) * (p[k] - mean[k])))
            .collect();
        let amplitude = |bin: usize| -> f64 {
            let mut sums = [[0.0; 2]; 3];
            for (i, p) in windowed.iter().enumerate() {
                let turn = (i * bin) % n;
                for (sum, x) in sums.iter_mut().zip(p) {
                    sum[0] += x * cos[turn];
                    sum[1] -= x * sin[turn];
                }
            }
            // The factor contains the mean of the window, which is one half.
            4.0 / n as f64 * sums.iter().flatten().map(|x| x * x).sum::<f64>().sqrt()
        };
        let bins = 0..n / 2;
        let frequencies = bins.clone().map(|bin| bin as f64 / (n as f64 * self.tick)).collect();
        Some((frequencies, bins.map(amplitude).collect()))
    }
}
