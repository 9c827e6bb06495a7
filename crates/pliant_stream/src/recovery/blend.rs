//! The offset of the visual state: corrections fade while position and velocity stay continuous.
//!
//! A correction moves the confirmed state by `-(e_q, e_v)` at once, so the visual state must carry
//! the offset `(e_q, e_v)` and lose it over `s` ticks. Position and velocity form one error: a
//! velocity offset integrates, so fading the two independently leaves `h e_v (s - 1) / 2` behind.
//! The offset fades along the cubic with `o(0) = e_q`, `o'(0) = e_v`, `o(1) = o'(1) = 0`:
//!
//! ```text
//! o(x)  = e_q (1 - x)^2 (1 + 2x) + e_v T x (1 - x)^2       x = age / s, T = s h
//! o'(x) = [e_q 6 x (x - 1) + e_v T (1 - x)(1 - 3x)] / T
//! ```
//!
//! Corrections of different ticks add up. Each is exactly zero after `s` ticks.

use std::collections::VecDeque;

/// The most corrections that fade at a time. Beyond this, the two oldest are merged into one whose
/// fade starts again.
const CAPACITY: usize = 16;

#[derive(Debug, Clone, Default)]
struct Correction {
    age: u32,
    q: Vec<f64>,
    v: Vec<f64>,
}

/// Offsets of all coordinates that still fade.
#[derive(Debug, Clone)]
pub struct Blend {
    h: f64,
    ticks: u32,
    running: VecDeque<Correction>,
    spare: Vec<Correction>,
}

impl Blend {
    /// Creates an empty blend whose offsets fade over `ticks` (at least 1) steps of `h` seconds.
    pub fn new(h: f64, ticks: u16) -> Self {
        Self { h, ticks: u32::from(ticks.max(1)), running: VecDeque::new(), spare: Vec::new() }
    }

    /// Removes all offsets.
    pub fn clear(&mut self) {
        self.spare.extend(self.running.drain(..));
    }

    /// Returns true when no offset is left, so that the visual state equals the confirmed state.
    pub fn is_empty(&self) -> bool {
        self.running.is_empty()
    }

    /// Adds the offset `visual - confirmed` that a correction just made, one value per coordinate.
    pub fn add(&mut self, q: impl Iterator<Item = f64>, v: impl Iterator<Item = f64>) {
        if self.running.len() >= CAPACITY {
            self.merge_oldest();
        }
        let mut new = self.spare.pop().unwrap_or_default();
        new.age = 0;
        new.q.clear();
        new.q.extend(q);
        new.v.clear();
        new.v.extend(v);
        if new.q.iter().chain(&new.v).any(|x| *x != 0.0) {
            self.running.push_back(new);
        } else {
            self.spare.push(new);
        }
    }

    fn merge_oldest(&mut self) {
        let (Some(a), Some(mut b)) = (self.running.pop_front(), self.running.pop_front()) else { return };
        let (wa, wb) = (self.weights(a.age), self.weights(b.age));
        for k in 0..b.q.len().min(a.q.len()) {
            let q = wa[0] * a.q[k] + wa[1] * a.v[k] + wb[0] * b.q[k] + wb[1] * b.v[k];
            let v = wa[2] * a.q[k] + wa[3] * a.v[k] + wb[2] * b.q[k] + wb[3] * b.v[k];
            (b.q[k], b.v[k]) = (q, v);
        }
        b.age = 0;
        self.running.push_back(b);
        self.spare.push(a);
    }

    /// Weights of an offset after `age` ticks: `o = w0 e_q + w1 e_v`, `o' = w2 e_q + w3 e_v`.
    fn weights(&self, age: u32) -> [f64; 4] {
        if age >= self.ticks {
            return [0.0; 4];
        }
        let x = f64::from(age) / f64::from(self.ticks);
        let t = f64::from(self.ticks) * self.h;
        let y = 1.0 - x;
        [y * y * (1.0 + 2.0 * x), t * x * y * y, -6.0 * x * y / t, y * (1.0 - 3.0 * x)]
    }

    /// Multiplies all offsets by `share`.
    pub fn scale(&mut self, share: f64) {
        for x in self.running.iter_mut().flat_map(|c| c.q.iter_mut().chain(&mut c.v)) {
            *x *= share;
        }
    }

    /// Ages all offsets by one tick and removes those that have faded.
    pub fn advance(&mut self) {
        for c in &mut self.running {
            c.age += 1;
        }
        while self.running.front().is_some_and(|c| c.age >= self.ticks) {
            self.spare.extend(self.running.pop_front());
        }
        // A merged correction stands behind younger ones, so the loop above does not always reach
        // it.
        self.running.retain(|c| c.age < self.ticks);
    }

    /// Adds the current offsets to coordinates and velocities.
    pub fn apply(&self, q: &mut [f64], v: &mut [f64]) {
        for c in &self.running {
            let w = self.weights(c.age);
            for ((q, v), (eq, ev)) in q.iter_mut().zip(v.iter_mut()).zip(c.q.iter().zip(&c.v)) {
                *q += w[0] * eq + w[1] * ev;
                *v += w[2] * eq + w[3] * ev;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(blend: &Blend) -> (f64, f64) {
        let (mut q, mut v) = ([0.0], [0.0]);
        blend.apply(&mut q, &mut v);
        (q[0], v[0])
    }

    #[test]
    fn offset_starts_as_given_and_is_gone_after_its_ticks() {
        let mut blend = Blend::new(0.025, 50);
        blend.add([2.0].into_iter(), [-3.0].into_iter());
        assert_eq!(at(&blend), (2.0, -3.0), "continuous in position and velocity");
        for _ in 0..50 {
            blend.advance();
        }
        assert_eq!(at(&blend), (0.0, 0.0));
        assert!(blend.is_empty());
    }

    #[test]
    fn velocity_is_the_derivative_of_position() {
        // The central difference has an error of order h^2, so the step must be small.
        let (h, ticks) = (1e-4, 1000);
        let mut blend = Blend::new(h, ticks);
        blend.add([1.0].into_iter(), [4.0].into_iter());
        let mut all = vec![at(&blend)];
        for _ in 0..ticks {
            blend.advance();
            all.push(at(&blend));
        }
        for w in all.windows(3) {
            let slope = (w[2].0 - w[0].0) / (2.0 * h);
            assert!((slope - w[1].1).abs() < 1e-4, "slope {slope}, velocity {}", w[1].1);
        }
    }

    #[test]
    fn one_tick_of_blend_corrects_at_once() {
        let mut blend = Blend::new(0.025, 1);
        blend.add([2.0].into_iter(), [-3.0].into_iter());
        blend.advance();
        assert_eq!(at(&blend), (0.0, 0.0));
    }

    #[test]
    fn bounded_and_continuous_when_merging() {
        let mut blend = Blend::new(0.025, 4000);
        for _ in 0..100 {
            let before = at(&blend);
            blend.add([0.5].into_iter(), [0.1].into_iter());
            let after = at(&blend);
            assert!((after.0 - before.0 - 0.5).abs() < 1e-12, "merging must not move what is shown");
            assert!((after.1 - before.1 - 0.1).abs() < 1e-12);
            blend.advance();
        }
        assert!(blend.running.len() <= CAPACITY);
    }
}
