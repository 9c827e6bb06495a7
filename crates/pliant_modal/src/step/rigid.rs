//! Where a body is. An anchored body's frame stays where it is put; a free body's frame is its rigid motion.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use crate::{ModalModel, StepError, error::finite};

/// Pose and momentum of a body. The point that it carries is the center of mass at rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Center of mass at rest, in body axes, m: what `position` is the image of.
    pivot: Vector3<f64>,
    position: Vector3<f64>,
    rotation: UnitQuaternion<f64>,
    velocity: Vector3<f64>,
    /// About the center of mass, world axes, kg m^2/s: kept instead of the angular velocity, so that flight conserves it to rounding.
    spin: Vector3<f64>,
}

impl Default for Frame {
    fn default() -> Self {
        let zero = Vector3::zeros();
        Self { pivot: zero, position: zero, rotation: UnitQuaternion::identity(), velocity: zero, spin: zero }
    }
}

impl Frame {
    /// The frame in which the body stands as its model was baked.
    pub fn at_rest(model: &ModalModel) -> Self {
        let pivot = Vector3::from(model.center_of_mass());
        Self { pivot, position: pivot, ..Self::default() }
    }

    /// World position of the model's origin, m.
    pub fn origin(&self) -> [f64; 3] {
        (self.position - self.rotation * self.pivot).into()
    }

    /// World position of the center of mass, m.
    pub fn center(&self) -> [f64; 3] {
        self.position.into()
    }

    /// Rotation from body to world axes as a unit quaternion x, y, z, w.
    pub fn orientation(&self) -> [f64; 4] {
        let q = self.rotation.quaternion();
        [q.i, q.j, q.k, q.w]
    }

    /// Velocity of the center of mass, m/s, world axes.
    pub fn velocity(&self) -> [f64; 3] {
        self.velocity.into()
    }

    /// Angular momentum about the center of mass, kg m^2/s, world axes.
    pub fn spin(&self) -> [f64; 3] {
        self.spin.into()
    }

    /// A frame from its parts: center of mass (m), orientation (x, y, z, w), velocity (m/s), spin (kg m^2/s), all in world axes.
    ///
    /// # Errors
    /// A number that is not finite, a quaternion of length zero.
    pub fn from_motion(
        model: &ModalModel,
        center: [f64; 3],
        orientation: [f64; 4],
        velocity: [f64; 3],
        spin: [f64; 3],
    ) -> Result<Self, StepError> {
        finite("frame position", &center)?;
        finite("frame velocity", &velocity)?;
        finite("frame spin", &spin)?;
        Ok(Self {
            pivot: model.center_of_mass().into(),
            position: center.into(),
            rotation: unit(orientation)?,
            velocity: velocity.into(),
            spin: spin.into(),
        })
    }

    pub(crate) fn set_pose(
        &mut self,
        model: &ModalModel,
        origin: [f64; 3],
        orientation: [f64; 4],
    ) -> Result<(), StepError> {
        finite("position", &origin)?;
        self.rotation = unit(orientation)?;
        self.pivot = model.center_of_mass().into();
        self.position = Vector3::from(origin) + self.rotation * self.pivot;
        Ok(())
    }

    /// Neither moves nor turns; where it is farther away than `most` (m) it is back at the origin.
    pub(crate) fn stop(&mut self, most: f64) {
        self.velocity = Vector3::zeros();
        self.spin = Vector3::zeros();
        if self.position.amax() > most {
            self.position = self.rotation * self.pivot;
        }
    }

    pub(crate) fn check(&self) -> Result<(), StepError> {
        finite("frame position", self.position.as_slice())?;
        finite("frame rotation", self.rotation.coords.as_slice())?;
        finite("frame velocity", self.velocity.as_slice())?;
        finite("frame spin", self.spin.as_slice())
    }

    /// Rotation from body to world axes.
    pub fn rotation(&self) -> &UnitQuaternion<f64> {
        &self.rotation
    }

    /// World position of a point of the body, m.
    pub fn to_world(self, local: Vector3<f64>) -> Vector3<f64> {
        self.position + self.rotation * (local - self.pivot)
    }

    /// World velocity of a point of the body that moves with the frame, m/s.
    pub fn velocity_at(&self, model: &ModalModel, local: Vector3<f64>) -> Vector3<f64> {
        self.velocity + self.angular_velocity(model).cross(&(self.rotation * (local - self.pivot)))
    }

    /// Angular velocity, rad/s, world axes.
    pub fn angular_velocity(&self, model: &ModalModel) -> Vector3<f64> {
        self.rotation * (inverse_inertia(model) * (self.rotation.inverse() * self.spin))
    }

    /// Turns freely for `h` s with the spin held. In body axes the spin `l` obeys `l' = l x w`, `w = I^-1 l`; the step is
    ///
    /// ```text
    /// R1 = R0 exp(h w),  l1 = exp(-h w) l0,  w = I^-1 (l0 + l1) / 2
    /// ```
    ///
    /// A rotation about `w` leaves the part of `l` along `w` as it is, so `(l1 - l0) . w = 0`: the kinetic energy `l . I^-1 l / 2` is kept, and so is
    /// `R l`, to rounding. (With `w` taken at the middle of an explicit step the energy creeps up: a body that turns once a second ends up turning about
    /// its axis of least inertia.)
    fn turn(&mut self, model: &ModalModel, h: f64) {
        /// Most that `|I^-1| |l| h` may be in one piece: the fixed point below then closes in by a factor of two or more a round.
        const PIECE: f64 = 1.0;
        const MOST_PIECES: f64 = 64.0;
        const ROUNDS: usize = 40;
        let inverse = inverse_inertia(model);
        let fastest = inverse.norm() * self.spin.norm();
        if fastest == 0.0 {
            return;
        }
        let pieces = (fastest * h / PIECE).ceil().clamp(1.0, MOST_PIECES);
        let h = h / pieces;
        for _ in 0..pieces as usize {
            let before = self.rotation.inverse() * self.spin;
            let mut omega = inverse * before;
            for _ in 0..ROUNDS {
                let after = UnitQuaternion::from_scaled_axis(-h * omega) * before;
                let next = inverse * (0.5 * (before + after));
                let moved = (next - omega).norm();
                omega = next;
                if moved <= 1e-15 * omega.norm() {
                    break;
                }
            }
            self.rotation *= UnitQuaternion::from_scaled_axis(h * omega);
        }
        self.rotation.renormalize_fast();
    }

    pub(crate) fn add_momentum(&mut self, model: &ModalModel, linear: Vector3<f64>, angular: Vector3<f64>) {
        self.velocity += linear / model.mass();
        self.spin += angular;
    }

    pub(crate) fn kinetic_energy(&self, model: &ModalModel) -> f64 {
        0.5 * model.mass() * self.velocity.norm_squared() + 0.5 * self.spin.dot(&self.angular_velocity(model))
    }

    pub(crate) fn momentum(&self, model: &ModalModel) -> ([f64; 3], [f64; 3]) {
        let linear = model.mass() * self.velocity;
        (linear.into(), (self.spin + self.position.cross(&linear)).into())
    }
}

fn unit(orientation: [f64; 4]) -> Result<UnitQuaternion<f64>, StepError> {
    finite("rotation", &orientation)?;
    let [x, y, z, w] = orientation;
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-9).ok_or(StepError::Input {
        what: "rotation",
        expected: "a quaternion of non-zero length",
        got: 0.0,
    })
}

fn inverse_inertia(model: &ModalModel) -> Matrix3<f64> {
    let i = model.inertia();
    // The model was refused unless this is positive definite.
    Matrix3::from_fn(|r, c| i[r][c]).try_inverse().unwrap_or_else(Matrix3::zeros)
}

/// What a pull does to the rigid motion within one step.
///
/// Velocities first, then positions with the new velocities (symplectic Euler): a stiff hand on a light body is then critically damped, where the
/// average-acceleration rule would ring for ever. Constant forces are integrated exactly.
#[derive(Debug, Clone, Copy)]
pub struct RigidMotion {
    step: f64,
    inverse_mass: f64,
    /// Body axes.
    inverse_inertia: Matrix3<f64>,
    /// The same with what the pulls themselves add, see [`RigidMotion::tighten`].
    turning: Matrix3<f64>,
    /// Torque by which tight pulls answer a turn, N m/rad, body axes: the `K` of [`RigidMotion::tighten`].
    tightness: Matrix3<f64>,
}

impl RigidMotion {
    /// Advances the frame by `h` (s) as if no hand held it, under `gravity` (m/s^2) and a force (N) and torque (N m) about the
    /// center of mass, all in world axes.
    pub fn predict(
        frame: &mut Frame,
        model: &ModalModel,
        h: f64,
        gravity: Vector3<f64>,
        force: Vector3<f64>,
        torque: Vector3<f64>,
    ) -> Self {
        let acceleration = gravity + force / model.mass();
        frame.position += h * frame.velocity + 0.5 * h * h * acceleration;
        frame.velocity += h * acceleration;
        frame.spin += h * torque;
        frame.turn(model, h);
        let inverse_inertia = inverse_inertia(model);
        let (inverse_mass, tightness) = (1.0 / model.mass(), Matrix3::zeros());
        Self { step: h, inverse_mass, inverse_inertia, turning: inverse_inertia, tightness }
    }

    /// Takes into account how `pulls` (N) at their arms (m, both body axes) turn with the body: two hands that pull apart keep it in line
    /// between them, as a weight keeps a pendulum. To a turn by `t` they answer with the torque `-K t`,
    /// `K = sum (p . a) 1 - (p a^T + a p^T) / 2`, and the turn of a step is that of the inertia `I + h^2 K`. What would drive the body
    /// out of line (hands that press) is left to the steps, which follow it.
    pub fn tighten(&mut self, model: &ModalModel, pulls: impl Iterator<Item = (Vector3<f64>, Vector3<f64>)>) {
        let mut k = Matrix3::zeros();
        for (arm, pull) in pulls {
            let outer = pull * arm.transpose();
            k += Matrix3::identity() * pull.dot(&arm) - 0.5 * (outer + outer.transpose());
        }
        self.turning = self.inverse_inertia;
        self.tightness = Matrix3::zeros();
        if !k.iter().all(|x| x.is_finite()) {
            return;
        }
        let mut own = k.symmetric_eigen();
        own.eigenvalues.apply(|x| *x = x.max(0.0));
        let i = model.inertia();
        let inertia = Matrix3::from_fn(|r, c| i[r][c]);
        self.tightness = own.recompose();
        let tight = inertia + self.step * self.step * self.tightness;
        self.turning = tight.try_inverse().unwrap_or(self.inverse_inertia);
    }

    /// How fast a unit pull at arm `b` makes the point at arm `a` within the step: 3x3, m/s/N, body
    /// axes. It moves it by so much times the step.
    pub(crate) fn velocity_response(&self, a: &Vector3<f64>, b: &Vector3<f64>) -> Matrix3<f64> {
        let turning = a.cross_matrix() * self.turning * b.cross_matrix().transpose();
        self.step * (Matrix3::identity() * self.inverse_mass + turning)
    }

    /// By how much a force (N) moves the center of mass within the step, m.
    pub(crate) fn way(&self, force: Vector3<f64>) -> Vector3<f64> {
        self.step * self.step * self.inverse_mass * force
    }

    /// The torque (N m, body axes) by which tight pulls have answered a turn (rad) already.
    pub(crate) fn slack(&self, turned: &Vector3<f64>) -> Vector3<f64> {
        self.tightness * turned
    }

    /// The turn (rad, body axes) that a step whose pulls are told at `turned` makes when they are none.
    pub(crate) fn unpulled(&self, turned: &Vector3<f64>) -> Vector3<f64> {
        self.step * self.step * (self.turning * self.slack(turned))
    }

    /// Adds the pulls' total force and torque (world axes) to the predicted frame.
    pub fn apply(&self, frame: &mut Frame, model: &ModalModel, force: Vector3<f64>, torque: Vector3<f64>) {
        let h = self.step;
        frame.velocity += h * force * self.inverse_mass;
        frame.position += h * h * force * self.inverse_mass;
        let turn = h * h * (self.turning * (frame.rotation.inverse() * torque));
        // The torque that is left at the end of that turn is what the spin gains: h torque where nothing is tight.
        let i = model.inertia();
        let inertia = Matrix3::from_fn(|r, c| i[r][c]);
        frame.spin += frame.rotation * (inertia * turn) / h;
        frame.rotation = UnitQuaternion::from_scaled_axis(frame.rotation * turn) * frame.rotation;
        frame.rotation.renormalize_fast();
    }
}
