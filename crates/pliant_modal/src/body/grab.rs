//! A grab: a patch of the surface tied to a target.

use nalgebra::{Matrix3, Vector3};

use super::patch_position;
use crate::{BodyConfig, Coefficients, ModalModel, Patch, StepError};

/// Names a grab on its body. Never used twice by the same body.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct GrabId(pub(crate) u64);

/// How a hand holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GrabConfig {
    /// Stiffness of the hand's own spring (the device's coupling), N/m, in series with the patch's residual flexibility.
    /// `None`: the hand is as stiff as the patch it holds allows. Default: `None`.
    pub stiffness: Option<f64>,
    /// Relaxation time of the coupling's damper, s: the coupling is `lambda = C^-1 (gap + relaxation d(gap)/dt)`. 0 or more. Default: 0.
    pub relaxation: f64,
}

impl Default for GrabConfig {
    fn default() -> Self {
        Self { stiffness: None, relaxation: 0.0 }
    }
}

impl GrabConfig {
    fn check(&self) -> Result<(), StepError> {
        if let Some(k) = self.stiffness {
            StepError::check("grab stiffness", "finite N/m above 0", k.is_finite() && k > 0.0, k)?;
        }
        let r = self.relaxation;
        StepError::check("grab relaxation", "finite seconds, 0 or more", r.is_finite() && r >= 0.0, r)
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Grab {
    pub(crate) id: GrabId,
    pub(crate) config: GrabConfig,
    /// World axes, m.
    pub(crate) target: Vector3<f64>,
    pub(crate) last_target: Vector3<f64>,
    /// Residual flexibility and hand in series as they answer within a step, m/N, body axes.
    pub(crate) compliance: Matrix3<f64>,
    /// The body's part of it at the baked stiffness, m/N.
    baked: Matrix3<f64>,
    /// The body's part of it, at once, m/N.
    residual: Matrix3<f64>,
    creeping: Creeping,
    /// How far the residual flexibility has flown, m, body axes; see [`Relaxation`].
    pub(crate) flow: Vector3<f64>,
    /// Force on the body: body axes while a step is solved, world axes (N) between steps.
    pub(crate) pull: Vector3<f64>,
    /// Target minus where the patch would be without hands, m, body axes.
    pub(crate) gap: Vector3<f64>,
    /// Patch from the centre of mass, m, body axes.
    pub(crate) arm: Vector3<f64>,
    rest: Vector3<f64>,
    displacement: Vec<Vector3<f64>>,
    rotation: Vec<Vector3<f64>>,
    rows: Vec<Vector3<f64>>,
    at: Vector3<f64>,
}

/// What the modes leave out answers at once: `d = C pull + ratio y`, `time y' = d - y`. With the pull held over a step,
/// `y1 = carry y0 + gain C pull` and `d1 = (1 + ratio gain) C pull + ratio carry y0`.
#[derive(Debug, Clone, Copy, Default)]
struct Creeping {
    ratio: f64,
    carry: f64,
    gain: f64,
}

/// How a patch gives way at once at the baked stiffness, m/N, body axes.
pub(crate) fn give_at(model: &ModalModel, patch: &Patch, modes: usize) -> Result<Matrix3<f64>, StepError> {
    let count = model.surface().positions().len();
    if let Some(&(vertex, _)) = patch.entries().iter().find(|&&(v, _)| v as usize >= count) {
        return Err(StepError::Vertex { vertex, count });
    }
    let residual = model.flexibility_of(patch, modes);
    let residual = Matrix3::from_fn(|i, j| residual[i][j]);
    // A patch on an anchor has no flexibility at all, and a hand on it would pull with an infinite force: skin and fingertip give a
    // hundredth of the patch's own contact compliance.
    let info = model.info();
    let radius = patch.radius().max(1e-2 * model.size());
    let contact = 1e-2 * (1.0 - info.poisson * info.poisson) / (2.0 * info.young * radius);
    Ok(0.5 * (residual + residual.transpose()) + Matrix3::identity() * contact.max(f64::MIN_POSITIVE))
}

impl Grab {
    pub(crate) fn new(
        id: GrabId,
        model: &ModalModel,
        patch: &Patch,
        config: GrabConfig,
        modes: usize,
    ) -> Result<Self, StepError> {
        config.check()?;
        let surface = model.surface();
        let residual = give_at(model, patch, modes)?;
        let mut rest = Vector3::zeros();
        let mut displacement = vec![Vector3::zeros(); modes];
        let mut rotation = vec![Vector3::zeros(); modes];
        for &(vertex, weight) in patch.entries() {
            rest += weight * Vector3::from(surface.positions()[vertex as usize].map(f64::from));
            for mode in 0..modes {
                for axis in 0..3 {
                    displacement[mode][axis] +=
                        weight * f64::from(model.displacement_row(vertex, axis, mode));
                    rotation[mode][axis] += weight * f64::from(model.rotation_row(vertex, axis, mode));
                }
            }
        }
        let zero = Vector3::zeros();
        Ok(Self {
            id,
            config,
            target: zero,
            last_target: Vector3::repeat(f64::NAN),
            compliance: residual,
            baked: residual,
            residual,
            creeping: Creeping::default(),
            flow: zero,
            pull: zero,
            gap: zero,
            arm: zero,
            rest,
            rows: vec![zero; modes],
            displacement,
            rotation,
            at: zero,
        })
    }

    /// How what the modes leave out answers within a step; to be told before the first one.
    pub(crate) fn set_material(&mut self, config: &BodyConfig) {
        let h = config.step;
        self.residual = self.baked / config.stiffness_scale;
        let hand = Matrix3::identity() * self.config.stiffness.map_or(0.0, |k| 1.0 / k);
        match config.relaxation {
            None => {
                self.creeping = Creeping::default();
                self.flow = Vector3::zeros();
                self.compliance = self.residual + hand;
            }
            Some(material) => {
                let left = 1.0 - material.ratio;
                let gone = -(-left * h / material.time).exp_m1();
                self.creeping = Creeping { ratio: material.ratio, carry: 1.0 - gone, gain: gone / left };
                self.compliance = material.creep(h) * self.residual + hand;
            }
        }
    }

    /// How far the patch gives way in this step before anyone pulls, because it was pulled before, m, body axes.
    pub(crate) fn crept(&self) -> Vector3<f64> {
        self.creeping.ratio * self.creeping.carry * self.flow
    }

    /// Lets what the modes leave out flow under the pull of this step (body axes).
    pub(crate) fn relax(&mut self) {
        let Creeping { carry, gain, .. } = self.creeping;
        self.flow = carry * self.flow + gain * (self.residual * self.pull);
    }

    pub(crate) fn local_position(&self, q: &[f64], warped: bool) -> Vector3<f64> {
        patch_position(self.rest, &self.displacement, &self.rotation, q, warped, None)
    }

    /// Takes position and rows at `q`.
    pub(crate) fn linearise(&mut self, q: &[f64], warped: bool) {
        self.at =
            patch_position(self.rest, &self.displacement, &self.rotation, q, warped, Some(&mut self.rows));
    }

    /// Where the patch would be at `q`, on the tangent taken at `from`.
    pub(crate) fn ahead(&self, from: &[f64], q: &[f64]) -> Vector3<f64> {
        self.rows.iter().zip(from.iter().zip(q)).fold(self.at, |p, (row, (f, q))| p + row * (q - f))
    }

    /// Where the patch is where rows were last taken, m, body axes.
    pub(crate) fn at(&self) -> Vector3<f64> {
        self.at
    }

    pub(crate) fn row(&self, mode: usize) -> Vector3<f64> {
        self.rows[mode]
    }

    pub(crate) fn rows(&self) -> &[Vector3<f64>] {
        &self.rows
    }

    /// How fast the patch moves, m/s, as a damper on it is to see it: `before` and `q` a step of `h` seconds apart, `v` at its end.
    ///
    /// Of each mode the velocity at the end of the step, or the one over the step, whichever answers a push more. A mode that turns by more than half a
    /// period within a step answers with an end velocity the other way: a damper on that would drive it.
    pub(crate) fn speed(
        &self,
        coefficients: &[Coefficients],
        before: &[f64],
        q: &[f64],
        v: &[f64],
        h: f64,
    ) -> Vector3<f64> {
        let modes = self.rows.iter().zip(coefficients).zip(before.iter().zip(q).zip(v));
        modes.fold(Vector3::zeros(), |sum, ((row, c), ((before, q), v))| {
            let at_end = c.response[1] >= c.response[0] / h;
            sum + row * if at_end { *v } else { (q - before) / h }
        })
    }

    /// How fast the target moved since the last step, m/s; a fresh grab's has not.
    pub(crate) fn target_velocity(&self, step: f64) -> Vector3<f64> {
        if self.last_target.x.is_nan() { Vector3::zeros() } else { (self.target - self.last_target) / step }
    }
}
