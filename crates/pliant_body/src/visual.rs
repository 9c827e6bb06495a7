//! What the eye gets: the last two states of a body and the one between them that is on screen.

use bevy::{
    math::{DQuat, DVec3},
    prelude::*,
};

use crate::{BodyError, BodyState, step::Stepping};

/// Where a free body is, in world axes.
#[derive(Reflect, Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// World position of the model's origin, m.
    pub origin: DVec3,
    /// Rotation from body to world axes.
    pub orientation: DQuat,
}

/// The shown state of a body: its modal coordinates (and the pose of a free one) between the last two ticks.
///
/// A body that is [`Driven::Local`](crate::Driven::Local) gets it from its own steps. For a
/// [`Driven::Remote`](crate::Driven::Remote) body somebody else (the network, a replay, a script) calls [`push`](Self::push)
/// once a tick, or [`snap`](Self::snap) as often as wanted; the surface is then drawn from it exactly as for a local body.
///
/// Lengths: one coordinate per kept mode, kg^1/2 m.
#[derive(Component, Reflect, Debug)]
#[reflect(Component, from_reflect = false)]
pub struct VisualState {
    // Their lengths agree; nothing from outside may change one of them.
    #[reflect(ignore)]
    previous: Vec<f64>,
    #[reflect(ignore)]
    current: Vec<f64>,
    #[reflect(ignore)]
    shown: Vec<f64>,
    /// Ticks since the last push: 0 in the tick of the push.
    age: u8,
    settled: bool,
    /// Where between the last two states it stands, since the last push.
    at: Option<f64>,
    version: u64,
    /// Previous and current pose of a free body; an anchored one is where its transform is.
    poses: Option<[Pose; 2]>,
}

impl VisualState {
    pub(crate) fn new(q: &[f64]) -> Self {
        Self {
            previous: q.to_vec(),
            current: q.to_vec(),
            shown: q.to_vec(),
            age: 1,
            settled: true,
            at: None,
            version: 1,
            poses: None,
        }
    }

    /// Makes `q` the newest state; the picture moves from the one before to it during the coming tick.
    ///
    /// # Errors
    /// [`BodyError::VisualLength`] when there is not one coordinate per mode, [`BodyError::VisualNotFinite`] when one is NaN or
    /// infinite. The state is then as it was.
    pub fn push(&mut self, q: &[f64]) -> Result<(), BodyError> {
        self.check(q)?;
        std::mem::swap(&mut self.previous, &mut self.current);
        self.current.copy_from_slice(q);
        self.age = 0;
        self.at = None;
        self.settled = false;
        Ok(())
    }

    /// Shows `q` at once, without interpolation (a cut, a reset, a source that interpolates by itself).
    ///
    /// # Errors
    /// As [`push`](Self::push).
    pub fn snap(&mut self, q: &[f64]) -> Result<(), BodyError> {
        self.check(q)?;
        self.previous.copy_from_slice(q);
        self.current.copy_from_slice(q);
        self.shown.copy_from_slice(q);
        self.age = 1;
        self.settled = true;
        self.version += 1;
        Ok(())
    }

    /// [`push`](Self::push) for a free body, with the place it is at.
    ///
    /// # Errors
    /// As [`push`](Self::push); [`BodyError::PoseNotFinite`] for a pose with NaN or infinity.
    pub fn push_at(&mut self, q: &[f64], pose: Pose) -> Result<(), BodyError> {
        if !pose.origin.is_finite() || !pose.orientation.is_finite() {
            return Err(BodyError::PoseNotFinite {
                origin: pose.origin.into(),
                orientation: pose.orientation.into(),
            });
        }
        self.push(q)?;
        self.poses = Some([self.poses.map_or(pose, |[_, current]| current), pose]);
        Ok(())
    }

    /// What is on screen in this frame: one coordinate a kept mode, kg^1/2 m.
    pub fn q(&self) -> &[f64] {
        &self.shown
    }

    /// The newest state that was pushed: one coordinate a kept mode, kg^1/2 m.
    pub fn current(&self) -> &[f64] {
        &self.current
    }

    /// The state pushed before [`current`](Self::current), kg^1/2 m; the same one where a tick passed without a push.
    pub fn previous(&self) -> &[f64] {
        &self.previous
    }

    /// Grows with every change of [`q`](Self::q); a reader that keeps the last one it saw knows whether there is work.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// Whether the picture stands still: nothing was pushed for a tick.
    pub fn is_settled(&self) -> bool {
        self.settled
    }

    /// The next pose is where it is shown at once: there is none to come from.
    pub(crate) fn forget_pose(&mut self) {
        self.poses = None;
    }

    fn check(&self, q: &[f64]) -> Result<(), BodyError> {
        if q.len() != self.current.len() {
            return Err(BodyError::VisualLength { expected: self.current.len(), found: q.len() });
        }
        match q.iter().position(|x| !x.is_finite()) {
            Some(mode) => Err(BodyError::VisualNotFinite { mode, value: q[mode] }),
            None => Ok(()),
        }
    }

    fn begin_tick(&mut self) {
        self.age = self.age.saturating_add(1);
        if self.age == 1 && !self.settled {
            // Nobody has pushed yet in this tick. If nobody does, the picture stays at the newest state.
            self.previous.copy_from_slice(&self.current);
            self.poses = self.poses.map(|[_, current]| [current; 2]);
        }
    }

    /// Whether it is to be moved to `fraction` of the tick; not when it stands there already, as in every frame of a pause.
    fn is_behind(&self, fraction: f64) -> bool {
        !self.settled && (self.age > 0 || self.at != Some(fraction))
    }

    fn interpolate(&mut self, fraction: f64) {
        self.at = Some(fraction);
        for ((shown, a), b) in self.shown.iter_mut().zip(&self.previous).zip(&self.current) {
            *shown = a + (b - a) * fraction;
        }
        self.version += 1;
        self.settled = self.age > 0;
    }
}

pub(crate) fn begin_tick(mut states: Query<&mut VisualState>) {
    for mut state in &mut states {
        // Not a change that a reader of the component needs to see.
        state.bypass_change_detection().begin_tick();
    }
}

/// `PostUpdate`: moves the shown states to the fraction of a tick that this frame is at, and free bodies to where they are seen.
pub(crate) fn interpolate(
    fixed: Option<Res<Time<Fixed>>>,
    stepping: Res<Stepping>,
    mut bodies: Query<(&mut VisualState, &mut BodyState, &mut Transform)>,
) {
    let fraction = match &fixed {
        Some(fixed) if stepping.fixed => fixed.overstep_fraction_f64().clamp(0.0, 1.0),
        // Stepped once a frame: the newest state is the frame's own.
        _ => 1.0,
    };
    for (mut shown, mut state, mut transform) in &mut bodies {
        if !shown.is_behind(fraction) {
            continue;
        }
        shown.interpolate(fraction);
        if let Some([from, to]) = shown.poses
            // Somebody has put it elsewhere since: the next tick takes that.
            && state.is_placed(&transform.compute_affine())
        {
            transform.translation = from.origin.lerp(to.origin, fraction).as_vec3();
            transform.rotation = from.orientation.slerp(to.orientation, fraction).normalize().as_quat();
            // So that the body does not take its own writing for somebody else's.
            state.placed = Some(transform.compute_affine());
        }
    }
}
