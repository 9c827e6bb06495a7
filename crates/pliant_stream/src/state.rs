//! Names and plain data that cross the crate's border.

use std::fmt;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
pub use pliant_modal::State;
use pliant_modal::{Body, Frame, ModalModel};

/// A numbered step of the host. Ticks ascend by one per step of `h` seconds.
pub type Tick = u64;

/// Ticks on the wire are below this (2^48): 8,900 years at 1 kHz.
pub const TICK_LIMIT: Tick = 1 << 48;

/// At most so many grabs are streamed for one body and tick.
pub const MAX_GRABS: usize = 64;

/// At most so many modes are streamed for one body.
pub const MAX_MODES: usize = 4096;

/// Positions (m), displacements, reactions (N) and speeds beyond this are refused as damage.
pub const MAGNITUDE_LIMIT: f64 = 1e9;

/// A connection as the transport names it. The caller chooses it; the session only repeats it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct PeerId(pub u64);

impl PeerId {
    /// The peer that a guest talks to.
    pub const HOST: Self = Self(0);
}

/// A person in the session. The host numbers its guests from 1; 0 is a user at the host itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct UserId(pub u16);

impl UserId {
    /// The user who sits at the host.
    pub const HOST: Self = Self(0);
}

/// A body of the session, numbered by the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct BodyId(pub u16);

/// A grab, unique within the session: whose, and which of theirs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct GrabKey {
    /// Whose hand.
    pub user: UserId,
    /// Which of the user's grabs; numbers are not reused within 65,536 grabs.
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
    /// At the origin, unrotated, at rest.
    fn default() -> Self {
        Self { position: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0], linear: [0.0; 3], angular: [0.0; 3] }
    }
}

impl Pose {
    /// The frame of a body: the model's origin, and how it moves.
    pub fn of(body: &Body) -> Self {
        Self::of_frame(body.model(), body.frame())
    }

    /// The same of a frame alone.
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

    /// The frame of a body in this pose; `None` when a number is not finite.
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

    /// True when every number is finite and within [`MAGNITUDE_LIMIT`] and the quaternion is not zero.
    pub fn is_valid(&self) -> bool {
        let norm: f64 = self.rotation.iter().map(|x| x * x).sum();
        in_range(&self.position)
            && in_range(&self.linear)
            && in_range(&self.angular)
            && norm.is_finite()
            && norm > 1e-12
    }
}

/// A grab as it was at one tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GrabState {
    /// Whose and which.
    pub key: GrabKey,
    /// Surface vertex in the middle of the patch.
    pub vertex: u32,
    /// Radius of the patch on the rest surface, m.
    pub radius: f64,
    /// Where the hand is, world, m.
    pub target: [f64; 3],
    /// Force that the body exerts on the hand, world, N.
    pub reaction: [f64; 3],
}

impl GrabState {
    /// True when every number is finite and within [`MAGNITUDE_LIMIT`] and the radius is not negative.
    pub fn is_valid(&self) -> bool {
        in_range(&self.target) && in_range(&self.reaction) && (0.0..=MAGNITUDE_LIMIT).contains(&self.radius)
    }
}

/// What the host knows of one body after one step: the input of [`crate::HostSession::publish`].
#[derive(Debug, Clone, Copy)]
pub struct TickState<'a> {
    /// The step's number. Must exceed the last one published for the body.
    pub tick: Tick,
    /// Modal coordinates, kg^1/2 m; one per mode of the model (or of its first modes).
    pub q: &'a [f64],
    /// Their velocities.
    pub v: &'a [f64],
    /// Their accelerations.
    pub a: &'a [f64],
    /// Modal flows of a body that relaxes, kg^1/2 m, as many as `q`; empty for an elastic one.
    pub z: &'a [f64],
    /// The rigid frame of a free body; `None` for an anchored one.
    pub pose: Option<Pose>,
    /// Everything that holds the body, at most [`MAX_GRABS`].
    pub grabs: &'a [GrabState],
    /// The body sleeps: nothing is sent until this is false again, except a slow reminder.
    pub resting: bool,
}

/// True when all are finite and at most [`MAGNITUDE_LIMIT`].
pub(crate) fn in_range(values: &[f64]) -> bool {
    values.iter().all(|x| x.abs() <= MAGNITUDE_LIMIT)
}
