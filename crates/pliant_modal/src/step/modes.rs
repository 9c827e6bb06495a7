//! The recurrences of all modes, stored by column, so that loops over the modes vectorize.

use std::sync::{Arc, Mutex, PoisonError, Weak};

use super::{State, StepSettings};
use crate::{Coefficients, Integrator, ModalModel, StepError};

/// The coefficients of a model that kernels have, each with what it was made for. Kernels with the
/// same settings share theirs, so that the steps of a crowd find them in the cache.
#[derive(Debug, Clone, Default)]
pub(crate) struct SharedModes(Arc<Mutex<Vec<Weak<Modes>>>>);

impl SharedModes {
    /// Returns what [`Modes::new`] makes, or the same made before.
    pub(crate) fn get(
        &self,
        model: &ModalModel,
        settings: &StepSettings,
        count: usize,
        h: f64,
    ) -> Result<Arc<Modes>, StepError> {
        let of = MadeFor::new(model, settings, count, h);
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(modes) = known.iter().filter_map(Weak::upgrade).find(|modes| modes.made_for == of) {
            return Ok(modes);
        }
        let modes = Arc::new(Modes::new(model, settings, count, h)?);
        known.retain(|modes| modes.strong_count() > 0);
        known.push(Arc::downgrade(&modes));
        Ok(modes)
    }
}

/// What coefficients depend on besides the model.
#[derive(Debug, Clone, PartialEq)]
struct MadeFor {
    /// The settings without the gravity of the scene.
    settings: StepSettings,
    count: usize,
    /// Length of the step, s.
    h: f64,
}

impl MadeFor {
    fn new(model: &ModalModel, settings: &StepSettings, count: usize, h: f64) -> Self {
        let settings = StepSettings { gravity: [0.0; 3], ..*settings };
        Self { settings, count: count.min(model.mode_count()), h }
    }
}

/// Coefficients of one step for every mode.
#[derive(Debug, Clone)]
pub(crate) struct Modes {
    made_for: MadeFor,
    /// Angular frequencies as stepped, rad/s.
    pub(crate) omega: Vec<f64>,
    /// Damping coefficients as stepped, 1/s.
    pub(crate) damping: Vec<f64>,
    /// Factors on the old state, `free[row][column]`. Rows: q, v, a. Columns: q, v, a, force of the
    /// last step.
    free: [[Vec<f64>; 4]; 3],
    /// Change of q, v, a per unit modal force.
    pub(crate) response: [Vec<f64>; 3],
    /// Largest change of a coordinate per unit modal force.
    pub(crate) softest: f64,
    /// Whether the step also uses the old acceleration and force.
    memory: bool,
    viscous: Option<Viscous>,
    /// Whether the material is viscoelastic. Reduced elasticity then has no `viscous`.
    relaxes: bool,
}

/// Additional coefficients of a viscoelastic material, see [`crate::ViscoelasticCoefficients`].
#[derive(Debug, Clone)]
struct Viscous {
    onto: [Vec<f64>; 3],
    free: [Vec<f64>; 4],
    carry: Vec<f64>,
    response: Vec<f64>,
}

impl Modes {
    /// Computes the coefficients of the first `count` modes of a model at a step of `h` seconds.
    pub(crate) fn new(
        model: &ModalModel,
        settings: &StepSettings,
        count: usize,
        h: f64,
    ) -> Result<Self, StepError> {
        let made_for = MadeFor::new(model, settings, count, h);
        let count = made_for.count;
        let (omega, damping): (Vec<f64>, Vec<f64>) =
            (0..count).map(|mode| settings.mode(model, mode)).unzip();
        let reduced = settings.is_reduced(model);
        let (mut made, mut branches) = (Vec::with_capacity(count), Vec::new());
        for (&omega, &c) in omega.iter().zip(&damping) {
            match settings.relaxation {
                _ if reduced => made.push(Coefficients::reduced(omega, c, h)?),
                None => made.push(Coefficients::new(settings.integrator, omega, c, h)?),
                Some(relaxation) => {
                    let (one, viscoelastic) =
                        Coefficients::relaxing(settings.integrator, omega, c, relaxation, h)?;
                    made.push(one);
                    branches.push(viscoelastic);
                }
            }
        }
        let viscous = settings.relaxation.filter(|_| !reduced).map(|_| Viscous {
            onto: std::array::from_fn(|row| branches.iter().map(|f| f.onto[row]).collect()),
            free: std::array::from_fn(|column| branches.iter().map(|f| f.free[column]).collect()),
            carry: branches.iter().map(|f| f.carry).collect(),
            response: branches.iter().map(|f| f.response).collect(),
        });
        Ok(Self {
            made_for,
            omega,
            damping,
            free: std::array::from_fn(|row| {
                std::array::from_fn(|column| made.iter().map(|c| c.free[row][column]).collect())
            }),
            response: std::array::from_fn(|row| made.iter().map(|c| c.response[row]).collect()),
            softest: made.iter().fold(0.0, |most, c| c.response[0].max(most)),
            memory: settings.integrator != Integrator::Exact && !reduced,
            viscous,
            relaxes: settings.relaxation.is_some(),
        })
    }

    /// Number of modes.
    pub(crate) fn count(&self) -> usize {
        self.omega.len()
    }

    /// Whether the material is viscoelastic, so that a state has a `z`.
    pub(crate) fn is_viscous(&self) -> bool {
        self.relaxes
    }

    /// Steps all modes from `before` under a modal force and writes the result to `after`.
    pub(crate) fn advance(&self, before: &State, force: &[f64], after: &mut State) {
        let n = self.count();
        let (q, v, a, f) = (&before.q[..n], &before.v[..n], &before.a[..n], &before.f[..n]);
        let force = &force[..n];
        let rows = [&mut after.q, &mut after.v, &mut after.a];
        for ((columns, response), out) in self.free.iter().zip(&self.response).zip(rows) {
            let [by_q, by_v, by_a, by_f] = columns.each_ref().map(|c| &c[..n]);
            let (response, out) = (&response[..n], &mut out[..n]);
            if self.memory {
                for k in 0..n {
                    let old = (by_q[k] * q[k] + by_v[k] * v[k]) + (by_a[k] * a[k] + by_f[k] * f[k]);
                    out[k] = old + response[k] * force[k];
                }
            } else {
                for k in 0..n {
                    out[k] = (by_q[k] * q[k] + by_v[k] * v[k]) + response[k] * force[k];
                }
            }
        }
        let Some(viscous) = &self.viscous else { return };
        let z = &before.z[..n];
        for (onto, out) in viscous.onto.iter().zip([&mut after.q, &mut after.v, &mut after.a]) {
            for ((out, onto), z) in out.iter_mut().zip(onto).zip(z) {
                *out += onto * z;
            }
        }
        let [by_q, by_v, by_a, by_f] = viscous.free.each_ref().map(|c| &c[..n]);
        let (carry, response) = (&viscous.carry[..n], &viscous.response[..n]);
        for (k, out) in after.z.iter_mut().enumerate().take(n) {
            let old = (by_q[k] * q[k] + by_v[k] * v[k]) + (by_a[k] * a[k] + by_f[k] * f[k]);
            *out = old + carry[k] * z[k] + response[k] * force[k];
        }
    }

    /// Adds the response to a further modal force within the step.
    pub(crate) fn respond(&self, force: &[f64], state: &mut State) {
        add_response(&self.response[0], force, &mut state.q);
        self.respond_beyond(force, state);
    }

    /// Adds the same response to all but the coordinates, which have it.
    pub(crate) fn respond_beyond(&self, force: &[f64], state: &mut State) {
        add_response(&self.response[1], force, &mut state.v);
        add_response(&self.response[2], force, &mut state.a);
        if let Some(viscous) = &self.viscous {
            add_response(&viscous.response, force, &mut state.z);
        }
    }
}

fn add_response(response: &[f64], force: &[f64], out: &mut [f64]) {
    for ((out, response), force) in out.iter_mut().zip(response).zip(force) {
        *out += response * force;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bodies_with_the_same_settings_share_their_coefficients() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/bud.modal");
        let model = ModalModel::read(path).unwrap();
        let get = |settings: &StepSettings, h| {
            SharedModes::get(model.shared_modes(), &model, settings, usize::MAX, h).unwrap()
        };
        let settings = StepSettings::default();
        let one = get(&settings, 0.01);
        // The coefficients do not depend on the gravity of the scene.
        let heavy = StepSettings { gravity: [0.0, -9.81, 0.0], ..settings };
        assert!(Arc::ptr_eq(&one, &get(&heavy, 0.01)));
        let stiff = get(&StepSettings { stiffness_scale: 2.0, ..settings }, 0.01);
        assert!(stiff.omega[0] > one.omega[0]);
        let fast = get(&settings, 0.02);
        assert!(fast.response[0][0] > one.response[0][0]);
        // What nobody has any more is forgotten.
        drop((one, stiff));
        get(&settings, 0.03);
        assert_eq!(model.shared_modes().0.lock().unwrap().len(), 2);
    }
}
