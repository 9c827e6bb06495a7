//! Identifiers and plain data of the public interface.

use std::fmt;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
pub use pliant_modal::State;
use pliant_modal::{Body, Frame, ModalModel};

/// Number of a step of the host. Ticks ascend by one per step of `h` seconds.
pub type Tick = u64;

/// Upper bound of ticks on the wire, exclusive (2^48): 8,900 years at 1 kHz.
pub const TICK_LIMIT: Tick = 1 << 48;

/// Largest number of grabs that are streamed for one body and tick.
pub const MAX_GRABS: usize = 64;

/// Largest number of modes that are streamed for one body.
pub const MAX_MODES: usize = 4096;

/// Largest magnitude of positions and displacements (m), reactions (N) and speeds. Larger values
/// are refused as corrupt.
pub const MAGNITUDE_LIMIT: f64 = 1e9;

/// Identifies a connection of the transport. The caller chooses the number, and the session returns
/// it unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct PeerId(pub u64);

impl PeerId {
    /// The host, as a guest addresses it.
    pub const HOST: Self = Self(0);
}

/// Identifies a user in the session. The host numbers its guests from 1; 0 is a user at the host
/// itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct UserId(pub u16);

impl UserId {
    /// The user at the host itself.
    pub const HOST: Self = Self(0);
}

/// Identifies a body of the session. The host assigns the numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct BodyId(pub u16);

/// Identifies a grab within the session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct GrabKey {
    /// The user whose hand holds.
    pub user: UserId,
    /// The user's number for the grab. Numbers are not reused within 65,536 grabs.
    pub grab: u16,
}

impl fmt::Display for PeerId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

impl fmt::Display for BodyId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

/// The rigid frame of a free body: pose and twist, in world axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Origin of the body's frame, m.
    pub position: [f64; 3],
    /// Orientation as a unit quaternion (x, y, z, w).
    pub rotation: [f64; 4],
    /// Velocity of the origin, m/s.
    pub linear: [f64; 3],
    /// Angular velocity, rad/s.
    pub angular: [f64; 3],
}

impl Default for Pose {
    /// Returns the pose at the origin, unrotated and at rest.
    fn default() -> Self {
        Self { position: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0], linear: [0.0; 3], angular: [0.0; 3] }
    }
}

impl Pose {
    /// Returns the pose of a body: the frame at the model's origin and its twist.
    pub fn of(body: &Body) -> Self {
        Self::of_frame(body.model(), body.frame())
    }

    /// Returns the pose of a frame of `model`.
    pub fn of_frame(model: &ModalModel, frame: &Frame) -> Self {
        let angular = frame.angular_velocity(model);
        let origin = Vector3::from(frame.origin());
        let arm = origin - Vector3::from(frame.center());
        let linear = Vector3::from(frame.velocity()) + angular.cross(&arm);
        Self {
            position: origin.into(),
            rotation: frame.orientation(),
            linear: linear.into(),
            angular: angular.into(),
        }
    }

    /// Returns the frame of a body in this pose, or `None` when a number is not finite.
    pub fn frame(&self, model: &ModalModel) -> Option<Frame> {
        let turn = self.turn()?;
        let arm = turn * Vector3::from(model.center_of_mass());
        let angular = Vector3::from(self.angular);
        let center = Vector3::from(self.position) + arm;
        let velocity = Vector3::from(self.linear) + angular.cross(&arm);
        let inertia = model.inertia();
        let spin = turn * (Matrix3::from_fn(|i, j| inertia[i][j]) * (turn.inverse() * angular));
        Frame::from_motion(model, center.into(), self.rotation, velocity.into(), spin.into()).ok()
    }

    pub(crate) fn turn(&self) -> Option<UnitQuaternion<f64>> {
        let [x, y, z, w] = self.rotation;
        UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-12)
    }

    /// True when every number is finite and within [`MAGNITUDE_LIMIT`] and the quaternion is not
    /// zero.
    pub fn is_valid(&self) -> bool {
        let norm: f64 = self.rotation.iter().map(|x| x * x).sum();
        in_range(&self.position)
            && in_range(&self.linear)
            && in_range(&self.angular)
            && norm.is_finite()
            && norm > 1e-12
    }
}

/// State of a grab at one tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GrabState {
    /// Identifies the grab.
    pub key: GrabKey,
    /// Surface vertex at the center of the patch.
    pub vertex: u32,
    /// Radius of the patch on the rest surface, m.
    pub radius: f64,
    /// Position of the hand, world, m.
    pub target: [f64; 3],
    /// Force that the body exerts on the hand, world, N.
    pub reaction: [f64; 3],
}

impl GrabState {
    /// True when every number is finite and within [`MAGNITUDE_LIMIT`] and the radius is not
    /// negative.
    pub fn is_valid(&self) -> bool {
        in_range(&self.target) && in_range(&self.reaction) && (0.0..=MAGNITUDE_LIMIT).contains(&self.radius)
    }
}

/// State of one body after one step of the host: the input of [`crate::HostSession::publish`].
#[derive(Debug, Clone, Copy)]
pub struct TickState<'a> {
    /// Number of the step. It must exceed the last one published for the body.
    pub tick: Tick,
    /// Modal coordinates, kg^1/2 m, one per mode of the model (or of its first modes).
    pub q: &'a [f64],
    /// Velocities of the modal coordinates.
    pub v: &'a [f64],
    /// Accelerations of the modal coordinates.
    pub a: &'a [f64],
    /// Viscoelastic state of a body that relaxes, kg^1/2 m, as many values as `q`; empty for an
    /// elastic body.
    pub z: &'a [f64],
    /// The rigid frame of a free body; `None` for an anchored one.
    pub pose: Option<Pose>,
    /// All grabs of the body, at most [`MAX_GRABS`].
    pub grabs: &'a [GrabState],
    /// The body sleeps. The session sends nothing but a slow reminder until this is false again.
    pub resting: bool,
}

/// True when all values are finite and at most [`MAGNITUDE_LIMIT`] in magnitude.
pub(crate) fn in_range(values: &[f64]) -> bool {
    values.iter().all(|x| x.abs() <= MAGNITUDE_LIMIT)
}
