//! The columns of held patches at rest, and states that lose them.

use nalgebra::Vector3;

use super::{ElasticStep, HALVINGS, NOTHING, join};
use crate::{
    nonlinear::{Cholesky, ElasticEnergy},
    step::{HeldPatch, State},
};

/// How long a body yields at once when its shapes change, s.
const SETTLING: f64 = 0.05;

impl ElasticStep {
    /// Brings the columns to rest under the hands' forces (N, body axes), while the coordinates
    /// stay where they are.
    pub(crate) fn equilibrate_columns<'a>(
        &mut self,
        state: &mut State,
        pulls: impl Iterator<Item = (&'a HeldPatch, Vector3<f64>)>,
    ) {
        let columns = self.columns;
        let Some(shapes) = self.shapes.clone() else {
            state.s.clear();
            return;
        };
        let mut load = vec![0.0; columns];
        for (patch, pull) in pulls {
            let Some(rows) = shapes.rows(patch) else { continue };
            for (row, pull) in rows.iter().zip(pull.iter()) {
                load.iter_mut().zip(row).for_each(|(load, u)| *load += pull * u);
            }
        }
        join(columns, state, &mut self.q);
        self.come_to_rest(&load, &vec![0.0; columns]);
        state.s.clear();
        state.s.extend(self.q[..columns].iter().map(|s| if s.is_finite() { *s } else { 0.0 }));
    }

    /// Brings a body on to where it would go in a while under the elastic force on its coordinates
    /// (kg^1/2 m/s^2) that it had before its energy changed, so that what is stiff is at rest.
    pub(crate) fn settle(&mut self, state: &mut State, force: &[f64]) {
        if state.s.len() != self.columns {
            return;
        }
        join(self.columns, state, &mut self.q);
        let mut load = vec![0.0; self.q.len()];
        self.energy.force_at(&self.q, &mut load);
        load[self.columns..].iter_mut().zip(force).for_each(|(load, force)| *load = *force);
        let mut inertia = vec![0.0; self.q.len()];
        for (inertia, damping) in inertia[self.columns..].iter_mut().zip(&self.damping) {
            *inertia = (1.0 / SETTLING + damping) / SETTLING;
        }
        self.come_to_rest(&load, &inertia);
        if self.q.iter().all(|q| q.is_finite()) {
            let (columns, modal) = self.q.split_at(self.columns);
            state.s.clear();
            state.s.extend_from_slice(columns);
            state.q.copy_from_slice(modal);
            let mut now = vec![0.0; force.len()];
            self.force_at(state, &mut now);
            for (a, (force, now)) in state.a.iter_mut().zip(force.iter().zip(&now)) {
                *a += force - now;
            }
        }
    }

    /// Brings the first of `self.q`, as many as there are loads, to rest under these and `inertia`
    /// (1/s^2), which holds each of them where it is.
    fn come_to_rest(&mut self, load: &[f64], inertia: &[f64]) {
        /// Number of Newton rounds.
        const ROUNDS: usize = 8;
        let count = load.len();
        let start = self.q[..count].to_vec();
        let potential = |energy: &ElasticEnergy, q: &[f64]| {
            let load = load.iter().zip(q).map(|(f, q)| f * q).sum::<f64>();
            let away = q.iter().zip(&start).map(|(q, start)| (q - start).powi(2));
            energy.energy(q) - load
                + 0.5 * away.zip(inertia).map(|(away, inertia)| away * inertia).sum::<f64>()
        };
        let mut factor = Cholesky::new(count);
        for _ in 0..ROUNDS {
            self.energy.linearize(&self.q);
            for (i, (row, inertia)) in factor.matrix().chunks_exact_mut(count).zip(inertia).enumerate() {
                self.energy.tangent_row(i, &mut row[i..]);
                row[i] += inertia;
            }
            factor.factor();
            let away = self.q.iter().zip(&start).map(|(q, start)| q - start);
            let forces = self.energy.force().iter().zip(inertia.iter().zip(away));
            let forces = forces.map(|(force, (inertia, away))| force + inertia * away);
            let mut increment: Vec<f64> = load.iter().zip(forces).map(|(load, force)| load - force).collect();
            factor.solve(&mut increment);
            // The columns have energy one half each at one.
            let energies = increment.iter().zip(&self.omega2);
            let size: f64 = energies.map(|(increment, omega2)| 0.5 * omega2 * increment * increment).sum();
            let (before, old) = (potential(&self.energy, &self.q), self.q[..count].to_vec());
            let mut share = 1.0;
            for _ in 0..HALVINGS {
                for ((s, old), increment) in self.q.iter_mut().zip(&old).zip(&increment) {
                    *s = old + share * increment;
                }
                if potential(&self.energy, &self.q) <= before {
                    break;
                }
                share *= 0.5;
            }
            if size <= NOTHING * self.far {
                break;
            }
        }
    }

    /// Takes the elastic energy beyond `most` (J) from a state: from its velocities, and where
    /// these do not suffice from its coordinates, the stiff ones first. Its accelerations follow
    /// from both.
    pub(crate) fn lower(&mut self, most: f64, state: &mut State) {
        let mut resisted = self.resisted(state);
        self.lower_energy(most, state);
        for (before, after) in resisted.iter_mut().zip(self.resisted(state)) {
            *before -= after;
        }
        state.a.iter_mut().zip(resisted).for_each(|(a, changed)| *a += changed);
    }

    /// Elastic and damping force of a state, against its motion.
    fn resisted(&self, state: &State) -> Vec<f64> {
        let mut out = vec![0.0; state.q.len()];
        self.force_at(state, &mut out);
        let damping = self.damping.iter().zip(&state.v);
        out.iter_mut().zip(damping).for_each(|(out, (c, v))| *out += c * v);
        out
    }

    fn lower_energy(&mut self, most: f64, state: &mut State) {
        /// Largest number of rounds, and of halvings of an increment that goes too far.
        const ROUNDS: usize = 12;
        const BISECTIONS: usize = 24;
        let n = self.q.len();
        let mut all = self.joined(state);
        let mut begun = all.clone();
        let mut now = self.energy.energy(&all);
        let excess = now - most;
        if excess.is_nan() || excess <= 0.0 {
            return;
        }
        let kinetic: f64 = state.v.iter().map(|v| 0.5 * v * v).sum();
        let left = if kinetic > excess { (1.0 - excess / kinetic).sqrt() } else { 0.0 };
        state.v.iter_mut().for_each(|v| *v *= left);
        let most = most + kinetic.min(excess);
        let mut factor = Cholesky::new(n);
        for _ in 0..ROUNDS {
            if now.is_nan() || now <= most {
                break;
            }
            // The stiffness at rest beside the tangent: stiff directions go to where they rest,
            // soft ones half of the way.
            self.energy.linearize(&all);
            for (i, (row, omega2)) in factor.matrix().chunks_exact_mut(n).zip(&self.omega2).enumerate() {
                self.energy.tangent_row(i, &mut row[i..]);
                row[i] += omega2;
            }
            factor.factor();
            let mut increment: Vec<f64> = self.energy.force().iter().map(|force| -force).collect();
            factor.solve(&mut increment);
            begun.copy_from_slice(&all);
            let place = |all: &mut [f64], share: f64| {
                for ((q, begun), increment) in all.iter_mut().zip(&begun).zip(&increment) {
                    *q = begun + share * increment;
                }
            };
            // The shortest increment that suffices, or else the best.
            let (mut best, mut low, mut high) = ((now, 0.0), 0.0, 1.0);
            for i in 0..BISECTIONS {
                let share = if i == 0 { 1.0 } else { 0.5 * (low + high) };
                place(&mut all, share);
                let there = self.energy.energy(&all);
                if there <= most {
                    (best, high) = ((there, share), share);
                } else {
                    if there < best.0 && best.0 > most {
                        best = (there, share);
                    }
                    if best.0 <= most {
                        low = share;
                    } else if there < now {
                        break;
                    } else {
                        high = share;
                    }
                }
            }
            now = best.0;
            if best.1 == 0.0 {
                all.copy_from_slice(&begun);
                break;
            }
            place(&mut all, best.1);
        }
        // The rounds slow down where the energy is not convex. The shape then shrinks as a whole,
        // down to rest, where there is no energy.
        if now.is_nan() || now > most {
            begun.copy_from_slice(&all);
            let mut scale = |share: f64| {
                all.iter_mut().zip(&begun).for_each(|(q, begun)| *q = share * begun);
                self.energy.energy(&all)
            };
            let (mut low, mut high) = (0.0, 1.0);
            for _ in 0..BISECTIONS {
                let share = 0.5 * (low + high);
                if scale(share) <= most {
                    low = share;
                } else {
                    high = share;
                }
            }
            if low > 0.0 {
                scale(low);
            } else {
                all.fill(0.0);
            }
        }
        let (columns, modal) = all.split_at(self.columns);
        state.s.clear();
        state.s.extend_from_slice(columns);
        state.q.copy_from_slice(modal);
    }
}
