//! The hands' forces that a state implies: equation (10) of Tang et al. 2013.

use nalgebra::Vector3;

use super::{
    Hand, Kernel, State,
    patch::{Grams, Tangent, tangent},
    solve::System,
};

/// Computes the hands' forces that a state with its accelerations implies.
///
/// The modal force `f = a + c v + omega^2 (q - ratio z)` minus gravity is distributed over the
/// hands' patches by least squares, `min |f - sum rows^T pull|^2`. Modes are weighted by their
/// compliance. The forces of stiff modes are the least certain and would otherwise dominate.
#[derive(Debug, Clone)]
pub struct ImpliedPulls {
    /// Weight of each mode, `1 / omega^2`.
    softness: Vec<f64>,
    force: Vec<f64>,
    weight: Vec<f64>,
    grams: Grams,
    tangents: Vec<Tangent>,
    system: System,
}

impl ImpliedPulls {
    /// Makes a solver for the states of a kernel.
    pub fn new(kernel: &Kernel) -> Self {
        let softness: Vec<f64> = kernel.omega().iter().map(|w| 1.0 / w.powi(2).max(1e-12)).collect();
        let (force, weight) = (softness.clone(), softness.clone());
        let (grams, tangents, system) = (Grams::default(), Vec::new(), System::default());
        Self { softness, force, weight, grams, tangents, system }
    }

    /// Writes the forces on the body (N, world axes) into the `pull` of each hand.
    ///
    /// Hands with linearly dependent rows share the force. If a hand or the state has another
    /// number of modes, nothing changes.
    pub fn solve(&mut self, kernel: &Kernel, state: &State, hands: &mut [Hand]) {
        let (modes, settings) = (self.softness.len(), kernel.settings());
        if hands.is_empty()
            || hands.iter().any(|hand| hand.patch.modes() != modes)
            || [&state.q, &state.v, &state.a].iter().any(|slice| slice.len() != modes)
        {
            return;
        }
        self.grams.prepare(hands, &self.softness);
        let ratio = settings.relaxation.map_or(0.0, |relaxation| relaxation.ratio);
        kernel.elastic_force(state, &mut self.force);
        for (k, force) in self.force.iter_mut().enumerate() {
            let viscoelastic = ratio * state.z.get(k).copied().unwrap_or(0.0);
            let (omega, damping) = (kernel.omega()[k], kernel.damping()[k]);
            *force += state.a[k] + damping * state.v[k] - omega * omega * viscoelastic;
        }
        kernel.weight(&state.frame, &state.q, &mut self.weight);
        for (force, weight) in self.force.iter_mut().zip(&self.weight) {
            *force -= weight;
        }
        for (force, softness) in self.force.iter_mut().zip(&self.softness) {
            *force *= softness;
        }
        let (n, warp) = (3 * hands.len(), kernel.warps());
        self.system.clear(n, true);
        self.tangents.clear();
        for (i, hand) in hands.iter().enumerate() {
            let (_, t) = tangent(&hand.patch.rows().reduce(&state.q, warp), warp);
            let along = t * hand.patch.rows().reduce(&self.force, warp);
            self.system.right()[3 * i..3 * i + 3].copy_from_slice(along.as_slice());
            self.tangents.push(t);
        }
        let mut trace = 0.0;
        for i in 0..hands.len() {
            trace += (self.tangents[i] * self.grams.at(i, i) * self.tangents[i].transpose()).trace();
        }
        let ridge = 1e-9 * trace / n as f64 + f64::MIN_POSITIVE;
        for (i, a) in self.tangents.iter().enumerate() {
            for (j, b) in self.tangents[..=i].iter().enumerate() {
                let block = a * self.grams.at(i, j) * b.transpose();
                for x in 0..3 {
                    for y in 0..3 {
                        let own = if (i, x) == (j, y) { ridge } else { 0.0 };
                        self.system.set(3 * i + x, 3 * j + y, block[(x, y)] + own);
                    }
                }
            }
        }
        self.system.solve();
        let turn = state.frame.rotation();
        for (hand, pull) in hands.iter_mut().zip(self.system.right().as_chunks::<3>().0) {
            let pull = turn * Vector3::from(*pull);
            if pull.iter().all(|x| x.is_finite()) {
                hand.pull = pull;
            }
        }
    }
}
