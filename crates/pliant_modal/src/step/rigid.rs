//! Pose and rigid motion of a body.
//!
//! The frame of an anchored body stays in its given pose. The frame of a free body is its rigid
//! motion.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::{ModalModel, StepError, error::finite};

/// Pose and momentum of a body. The reference point is the center of mass at rest.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "PlainFrame", into = "PlainFrame")]
pub struct Frame {
    /// Center of mass at rest, m, body axes. `position` is the world position of this point.
    pivot: Vector3<f64>,
    position: Vector3<f64>,
    rotation: UnitQuaternion<f64>,
    velocity: Vector3<f64>,
    /// Angular momentum about the center of mass, kg m^2/s, world axes. It is stored instead of the
    /// angular velocity, so that flight conserves it up to rounding.
    spin: Vector3<f64>,
}

/// The form of a [`Frame`] in a file: its fields, with the rotation as x, y, z, w.
#[derive(Serialize, Deserialize)]
struct PlainFrame {
    pivot: [f64; 3],
    position: [f64; 3],
    rotation: [f64; 4],
    velocity: [f64; 3],
    spin: [f64; 3],
}

impl From<Frame> for PlainFrame {
    fn from(frame: Frame) -> Self {
        let Frame { pivot, position, velocity, spin, .. } = frame;
        let [pivot, position, velocity, spin] = [pivot, position, velocity, spin].map(Into::into);
        Self { pivot, position, rotation: frame.orientation(), velocity, spin }
    }
}

impl TryFrom<PlainFrame> for Frame {
    type Error = StepError;

    fn try_from(plain: PlainFrame) -> Result<Self, StepError> {
        let PlainFrame { pivot, position, rotation, velocity, spin } = plain;
        let [x, y, z, w] = rotation;
        let exact = Quaternion::new(w, x, y, z);
        // To normalize a rotation of length 1 again would change its last bits.
        let is_unit = (exact.norm() - 1.0).abs() < 1e-9;
        let rotation = if is_unit { UnitQuaternion::new_unchecked(exact) } else { unit(rotation)? };
        let [pivot, position, velocity, spin] = [pivot, position, velocity, spin].map(Vector3::from);
        let frame = Self { pivot, position, rotation, velocity, spin };
        finite("frame pivot", pivot.as_slice())?;
        frame.check()?;
        Ok(frame)
    }
}

impl Default for Frame {
    fn default() -> Self {
        let zero = Vector3::zeros();
        Self { pivot: zero, position: zero, rotation: UnitQuaternion::identity(), velocity: zero, spin: zero }
    }
}

impl Frame {
    /// Makes the frame in which the model was baked.
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

    /// Rotation from body to world axes, as a unit quaternion x, y, z, w.
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

    /// Makes a frame from center of mass (m), orientation (x, y, z, w), velocity (m/s) and spin
    /// (kg m^2/s), all in world axes.
    ///
    /// # Errors
    /// Returns an error if a number is not finite or the quaternion has length zero.
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

    /// Sets velocity and spin to zero. If the position is farther away than `most` (m), the frame
    /// returns to the origin.
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

    /// World position (m) of a point (m, body axes).
    pub fn to_world(self, local: Vector3<f64>) -> Vector3<f64> {
        self.position + self.rotation * (local - self.pivot)
    }

    /// Position in body axes (m) of a world point (m).
    pub(crate) fn to_local(self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation.inverse() * (point - self.position) + self.pivot
    }

    /// World velocity of a point that is fixed to the frame, m/s. The point is in body axes, m.
    pub fn velocity_at(&self, model: &ModalModel, local: Vector3<f64>) -> Vector3<f64> {
        self.velocity + self.angular_velocity(model).cross(&(self.rotation * (local - self.pivot)))
    }

    /// Angular velocity, rad/s, world axes.
    pub fn angular_velocity(&self, model: &ModalModel) -> Vector3<f64> {
        self.rotation * (inverse_inertia(model) * (self.rotation.inverse() * self.spin))
    }

    /// Turns the frame freely for `h` s with constant spin. In body axes the spin `l` obeys
    /// `l' = l x w` with `w = I^-1 l`. The step is
    ///
    /// ```text
    /// R1 = R0 exp(h w),  l1 = exp(-h w) l0,  w = I^-1 (l0 + l1) / 2
    /// ```
    ///
    /// A rotation about `w` keeps the part of `l` along `w`, so `(l1 - l0) . w = 0`. The kinetic
    /// energy `l . I^-1 l / 2` and `R l` are thus conserved up to rounding. (With `w` taken at the
    /// middle of an explicit step the energy grows slowly: a body that turns once a second ends up
    /// turning about its axis of least inertia.)
    fn turn(&mut self, model: &ModalModel, h: f64) {
        /// Largest value of `|I^-1| |l| h` in one piece. The fixed point below then converges by a
        /// factor of two or more per round.
        const PIECE: f64 = 1.0;
        const MAX_PIECES: f64 = 64.0;
        const ROUNDS: usize = 40;
        let inverse = inverse_inertia(model);
        let fastest = inverse.norm() * self.spin.norm();
        if fastest == 0.0 {
            return;
        }
        let pieces = (fastest * h / PIECE).ceil().clamp(1.0, MAX_PIECES);
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

    /// Adds a way (m) and a spin (kg m^2/s), world axes.
    pub(crate) fn shift(&mut self, way: Vector3<f64>, spin: Vector3<f64>) {
        self.position += way;
        self.spin += spin;
    }

    /// Multiplies the difference of velocity and spin to these.
    pub(crate) fn slow_to(&mut self, velocity: &Vector3<f64>, spin: &Vector3<f64>, factor: f64) {
        self.velocity = velocity + factor * (self.velocity - velocity);
        self.spin = spin + factor * (self.spin - spin);
    }

    /// Inertia about the center of mass, kg m^2, world axes.
    pub(crate) fn inertia(&self, model: &ModalModel) -> Matrix3<f64> {
        let (inertia, turn) = (model.inertia(), self.rotation.to_rotation_matrix());
        turn * Matrix3::from_fn(|i, j| inertia[i][j]) * turn.inverse()
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
    // The model checks guarantee that this matrix is positive definite.
    Matrix3::from_fn(|r, c| i[r][c]).try_inverse().unwrap_or_else(Matrix3::zeros)
}

/// Response of the rigid motion to forces within one step.
///
/// The step updates velocities first and then positions with the new velocities (symplectic Euler).
/// A stiff hand on a light body is then critically damped, where the average-acceleration rule
/// would ring forever. Constant forces are integrated exactly.
#[derive(Debug, Clone, Copy)]
pub struct RigidMotion {
    step: f64,
    inverse_mass: f64,
    /// Inverse of the inertia, body axes.
    inverse_inertia: Matrix3<f64>,
    /// Inverse of the inertia including the stiffness of the forces, see [`RigidMotion::tighten`].
    turning: Matrix3<f64>,
    /// Torque with which tension resists a turn, N m/rad, body axes: the `K` of
    /// [`RigidMotion::tighten`].
    tightness: Matrix3<f64>,
}

impl RigidMotion {
    /// Advances the frame by `h` (s) without hands.
    ///
    /// `gravity` (m/s^2), `force` (N) and `torque` (N m, about the center of mass) are in world
    /// axes.
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

    /// Takes into account that the forces of the hands turn with the body.
    ///
    /// `pulls` yields the arm (m) and force (N) of each hand, both in body axes. Two hands that
    /// pull apart keep the body in line between them, as gravity keeps a pendulum. The forces
    /// respond to a turn `t` with the torque `-K t`, where
    /// `K = sum (p . a) 1 - (p a^T + a p^T) / 2`, and the turn of a step is that of the inertia
    /// `I + h^2 K`. Negative eigenvalues of `K` (hands that press) would turn the body out of line.
    /// They are set to zero here, and the steps follow their effect.
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

    /// Velocity of the point at arm `a` per unit force at arm `b` within the step: 3x3, m/s/N, body
    /// axes. The displacement is this value times the step.
    pub(crate) fn velocity_response(&self, a: &Vector3<f64>, b: &Vector3<f64>) -> Matrix3<f64> {
        let turning = a.cross_matrix() * self.turning * b.cross_matrix().transpose();
        self.step * (Matrix3::identity() * self.inverse_mass + turning)
    }

    /// Displacement of the center of mass by a force (N) within the step, m.
    pub(crate) fn way(&self, force: Vector3<f64>) -> Vector3<f64> {
        self.step * self.step * self.inverse_mass * force
    }

    /// Torque (N m, body axes) with which tension has already resisted the turn `turned` (rad).
    pub(crate) fn slack(&self, turned: &Vector3<f64>) -> Vector3<f64> {
        self.tightness * turned
    }

    /// Turn (rad, body axes) of a step without forces, if the forces are computed at `turned`.
    pub(crate) fn unpulled(&self, turned: &Vector3<f64>) -> Vector3<f64> {
        self.step * self.step * (self.turning * self.slack(turned))
    }

    /// Adds the total force (N) and torque (N m) of the hands, in world axes, to the predicted
    /// frame.
    pub fn apply(&self, frame: &mut Frame, model: &ModalModel, force: Vector3<f64>, torque: Vector3<f64>) {
        let h = self.step;
        frame.velocity += h * force * self.inverse_mass;
        frame.position += h * h * force * self.inverse_mass;
        let turn = h * h * (self.turning * (frame.rotation.inverse() * torque));
        // The spin gains the torque that is left at the end of this turn, which is `h torque`
        // without tension.
        let i = model.inertia();
        let inertia = Matrix3::from_fn(|r, c| i[r][c]);
        frame.spin += frame.rotation * (inertia * turn) / h;
        frame.rotation = UnitQuaternion::from_scaled_axis(frame.rotation * turn) * frame.rotation;
        frame.rotation.renormalize_fast();
    }
}
