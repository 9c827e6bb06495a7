//! The dynamic state of a body.

use serde::{Deserialize, Serialize};

use super::Frame;

/// The state of a body at one tick.
///
/// All slices have one entry per stepped mode. `z` is empty where the material is elastic.
#[derive(Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct State {
    /// Modal coordinates, kg^1/2 m.
    pub q: Vec<f64>,
    /// Modal velocities, kg^1/2 m/s.
    pub v: Vec<f64>,
    /// Modal accelerations as the integrator defines them, kg^1/2 m/s^2.
    pub a: Vec<f64>,
    /// Modal forces of the last step, kg^1/2 m/s^2. Generalized-alpha uses these in the next step.
    pub f: Vec<f64>,
    /// Viscoelastic modal state, kg^1/2 m: the displacement of the dashpot of each
    /// mode's Maxwell branch. See [`Relaxation`](crate::Relaxation).
    pub z: Vec<f64>,
    /// Static coordinates of the own shapes of held patches, J^1/2 at the baked stiffness. Empty
    /// without such shapes. See [`HeldShapes`](crate::HeldShapes).
    pub s: Vec<f64>,
    /// Pose and rigid motion of the body.
    pub frame: Frame,
}

impl State {
    /// Makes a state of zeros in the default frame. A `viscous` material has a `z`.
    pub fn zero(modes: usize, viscous: bool) -> Self {
        let zero = vec![0.0; modes];
        let z = if viscous { zero.clone() } else { Vec::new() };
        let frame = Frame::default();
        Self { q: zero.clone(), v: zero.clone(), a: zero.clone(), f: zero, z, s: Vec::new(), frame }
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        self.q.len()
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.non_finite().is_none()
    }

    /// Limit on the magnitude of all numbers (kg^1/2 m and similar units). Above it, squares of
    /// coordinates and velocities may overflow in a step.
    const MAX: f64 = 1e100;

    /// Whether all numbers are small enough that a step without hands and pushes stays finite.
    pub(crate) fn is_moderate(&self) -> bool {
        let frame = &self.frame;
        let rigid = frame.velocity().into_iter().chain(frame.spin()).chain(frame.center());
        let modes = [&self.q, &self.v, &self.a, &self.f, &self.z, &self.s].into_iter().flatten().copied();
        modes.chain(rigid).all(|x| x.abs() <= Self::MAX)
    }

    /// Sets the body to rest, undeformed, at the pose of its frame. The frame returns to the origin
    /// if its position is beyond the limit.
    pub(crate) fn stop(&mut self) {
        for slice in [&mut self.q, &mut self.v, &mut self.a, &mut self.f, &mut self.z, &mut self.s] {
            slice.fill(0.0);
        }
        self.frame.stop(Self::MAX);
    }

    /// Name of the first quantity that is not finite, if any.
    pub(crate) fn non_finite(&self) -> Option<&'static str> {
        let named = [
            ("modal coordinates", &self.q),
            ("modal velocities", &self.v),
            ("modal accelerations", &self.a),
            ("modal viscoelastic states", &self.z),
            ("coordinates of held patches", &self.s),
        ];
        let bad = named.into_iter().find(|(_, slice)| slice.iter().any(|x| !x.is_finite()));
        bad.map(|(what, _)| what).or(self.frame.check().is_err().then_some("the frame"))
    }
}

impl Clone for State {
    fn clone(&self) -> Self {
        let mut copy = Self::default();
        copy.clone_from(self);
        copy
    }

    /// Keeps the allocations of `self`, so that a step saves its state without allocating. A
    /// derived `clone_from` would allocate.
    fn clone_from(&mut self, from: &Self) {
        let Self { q, v, a, f, z, s, frame } = from;
        self.q.clone_from(q);
        self.v.clone_from(v);
        self.a.clone_from(a);
        self.f.clone_from(f);
        self.z.clone_from(z);
        self.s.clone_from(s);
        self.frame = *frame;
    }
}
