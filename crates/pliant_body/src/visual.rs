//! The visual state of a body: its last two states and the interpolated state on screen.

use std::sync::Arc;

use bevy::{
    math::{DQuat, DVec3},
    prelude::*,
};
use pliant_modal::HeldShapes;

use crate::{BodyError, BodyState, step::Stepping};

/// The pose of a free body, in world axes.
#[derive(Reflect, Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub struct Pose {
    /// World position of the model's origin, m.
    pub origin: DVec3,
    /// Rotation from body axes to world axes.
    pub orientation: DQuat,
}

/// The visual state of a body: modal coordinates, and a free body's pose, between the last two
/// ticks.
///
/// The steps of a [`Driven::Local`](crate::Driven::Local) body write this state. For a
/// [`Driven::Remote`](crate::Driven::Remote) body another source (the network, a replay, a script)
/// calls [`push`](Self::push) once per tick, or [`snap`](Self::snap) at any time. The surface is
/// drawn from this state in the same way as for a local body.
///
/// Every state has one coordinate per kept mode, kg^1/2 m.
///
/// A saved state has no own shapes of held patches. The next tick pushes them again.
#[derive(Component, Reflect, Debug, Default, Clone)]
#[reflect(Component, Debug, Default, Clone)]
pub struct VisualState {
    // The three vectors have the same length. Nothing outside may change the length of one of them.
    previous: Vec<f64>,
    current: Vec<f64>,
    displayed: Vec<f64>,
    /// Ticks since the last push: 0 in the tick of the push.
    age: u8,
    shows_newest: bool,
    /// Fraction of the tick to which the state was interpolated since the last push.
    at: Option<f64>,
    version: u64,
    #[reflect(ignore, clone)]
    held: Option<HeldColumns>,
    /// Previous and current pose of a free body. An anchored body is at its transform.
    poses: Option<[Pose; 2]>,
}

/// What the own shapes of held patches add to the states.
#[derive(Debug, Clone)]
struct HeldColumns {
    shapes: Arc<HeldShapes>,
    previous: Vec<f64>,
    current: Vec<f64>,
    displayed: Vec<f64>,
    /// Whether the body has them no more. They then end when the picture is at the newest state.
    ends: bool,
}

impl VisualState {
    pub(crate) fn new(q: &[f64]) -> Self {
        Self {
            previous: q.to_vec(),
            current: q.to_vec(),
            displayed: q.to_vec(),
            age: 1,
            shows_newest: true,
            at: None,
            version: 1,
            held: None,
            poses: None,
        }
    }

    /// Makes `q` the newest state.
    ///
    /// During the coming tick the picture moves from the state before it to `q`.
    ///
    /// # Errors
    /// Returns [`BodyError::VisualLength`] if `q` does not have one coordinate per mode, and
    /// [`BodyError::VisualNotFinite`] if a coordinate is NaN or infinite. The state then stays
    /// unchanged.
    pub fn push(&mut self, q: &[f64]) -> Result<(), BodyError> {
        self.check(q)?;
        std::mem::swap(&mut self.previous, &mut self.current);
        self.current.copy_from_slice(q);
        if let Some(held) = &mut self.held {
            held.previous.copy_from_slice(&held.current);
        }
        self.age = 0;
        self.at = None;
        self.shows_newest = false;
        Ok(())
    }

    /// Shows `q` at once, without interpolation.
    ///
    /// This suits a cut, a reset or a source that interpolates by itself.
    ///
    /// # Errors
    /// Returns the errors of [`push`](Self::push).
    pub fn snap(&mut self, q: &[f64]) -> Result<(), BodyError> {
        self.check(q)?;
        self.previous.copy_from_slice(q);
        self.current.copy_from_slice(q);
        self.displayed.copy_from_slice(q);
        self.age = 1;
        self.shows_newest = true;
        self.version += 1;
        Ok(())
    }

    /// Pushes the newest state of a free body together with its pose, see [`push`](Self::push).
    ///
    /// # Errors
    /// Returns the errors of [`push`](Self::push), and [`BodyError::PoseNotFinite`] if the pose
    /// contains NaN or infinity.
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

    /// Adds the own shapes of held patches at `s` to the newest state, after [`push`](Self::push).
    /// `None` takes them away.
    ///
    /// Values that do not fit the shapes, or are not finite, count as no shapes.
    pub fn hold(&mut self, columns: Option<(&Arc<HeldShapes>, &[f64])>) {
        let sound = |(shapes, s): &(&Arc<HeldShapes>, &[f64])| {
            s.len() == shapes.columns() && s.iter().all(|x| x.is_finite())
        };
        match (columns.filter(sound), &mut self.held) {
            (Some((shapes, s)), Some(held)) if Arc::ptr_eq(shapes, &held.shapes) => {
                held.current.copy_from_slice(s);
                held.ends = false;
            }
            (Some((shapes, s)), held) => {
                // Shapes of other patches go on from where the old ones were.
                let from = if held.is_some() { s.to_vec() } else { vec![0.0; s.len()] };
                let (shapes, current, displayed) = (shapes.clone(), s.to_vec(), from.clone());
                *held = Some(HeldColumns { shapes, previous: from, current, displayed, ends: false });
            }
            // They fade over one tick.
            (None, Some(held)) if !held.ends => {
                held.current.fill(0.0);
                held.ends = true;
            }
            (None, held) => *held = None,
        }
        // A state that was shown at once is shown with its columns at once.
        if self.shows_newest
            && let Some(held) = &mut self.held
        {
            held.previous.copy_from_slice(&held.current);
            held.displayed.copy_from_slice(&held.current);
            if held.ends {
                self.held = None;
            }
        }
    }

    /// The own shapes of held patches in the state on screen, and their coordinates.
    pub fn held(&self) -> Option<(&Arc<HeldShapes>, &[f64])> {
        self.held.as_ref().map(|held| (&held.shapes, &held.displayed[..]))
    }

    /// Writes the coordinates with which the model draws the state on screen. They are
    /// [`q`](Self::q), unless there are own shapes of held patches ([`HeldShapes::draw`]), which
    /// then have to be added to the surface ([`HeldShapes::add_to`]).
    pub fn draw(&self, q: &mut Vec<f64>) {
        q.clear();
        q.extend_from_slice(&self.displayed);
        if let Some((shapes, s)) = self.held() {
            shapes.draw(s, q);
        }
    }

    /// Returns the state on screen in this frame: one coordinate per kept mode, kg^1/2 m.
    pub fn q(&self) -> &[f64] {
        &self.displayed
    }

    /// Returns the newest pushed state: one coordinate per kept mode, kg^1/2 m.
    pub fn current(&self) -> &[f64] {
        &self.current
    }

    /// Returns the state pushed before [`current`](Self::current), kg^1/2 m. Both are equal after a
    /// tick without a push.
    pub fn previous(&self) -> &[f64] {
        &self.previous
    }

    /// Returns a number that grows with every change of [`q`](Self::q).
    ///
    /// A reader that stores the last number can tell whether `q` changed.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// Whether the state on screen is constant, because nothing was pushed for a tick.
    pub fn is_settled(&self) -> bool {
        self.shows_newest
    }

    /// Whether all of its states have this number of modal coordinates, and their poses a place.
    pub(crate) fn fits(&self, modes: usize) -> bool {
        let states = [&self.previous, &self.current, &self.displayed];
        let poses = self.poses.iter().flatten();
        states.iter().all(|q| q.len() == modes && q.iter().all(|x| x.is_finite()))
            && poses.into_iter().all(|pose| pose.origin.is_finite() && pose.orientation.is_finite())
    }

    /// Removes the poses, so that the next pose is shown at once without interpolation.
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
        if self.age == 1 && !self.shows_newest {
            // Nothing was pushed yet in this tick. Without a push the picture stays at the newest
            // state.
            self.previous.copy_from_slice(&self.current);
            if let Some(held) = &mut self.held {
                held.previous.copy_from_slice(&held.current);
            }
            self.poses = self.poses.map(|[_, current]| [current; 2]);
        }
    }

    /// Whether the state must be interpolated to `fraction` of the tick. It must not if it is
    /// already there, as in every frame of a pause.
    fn is_behind(&self, fraction: f64) -> bool {
        !self.shows_newest && (self.age > 0 || self.at != Some(fraction))
    }

    fn interpolate(&mut self, fraction: f64) {
        self.at = Some(fraction);
        for ((displayed, a), b) in self.displayed.iter_mut().zip(&self.previous).zip(&self.current) {
            *displayed = a + (b - a) * fraction;
        }
        if let Some(held) = &mut self.held {
            for ((displayed, a), b) in held.displayed.iter_mut().zip(&held.previous).zip(&held.current) {
                *displayed = a + (b - a) * fraction;
            }
        }
        self.version += 1;
        self.shows_newest = self.age > 0;
        if self.shows_newest {
            self.held.take_if(|held| held.ends);
        }
    }
}

pub(crate) fn begin_tick(mut states: Query<&mut VisualState>) {
    for mut state in &mut states {
        // Readers of the component do not need to see this change.
        state.bypass_change_detection().begin_tick();
    }
}

/// Interpolates the visual states, and the transforms of free bodies, to this frame's fraction of a
/// tick. Runs in `PostUpdate`.
pub(crate) fn interpolate(
    fixed: Option<Res<Time<Fixed>>>,
    stepping: Res<Stepping>,
    mut bodies: Query<(&mut VisualState, &mut BodyState, &mut Transform)>,
) {
    let fraction = match &fixed {
        Some(fixed) if stepping.fixed => fixed.overstep_fraction_f64().clamp(0.0, 1.0),
        // With one step per frame, the newest state belongs to this frame.
        _ => 1.0,
    };
    for (mut displayed, mut state, mut transform) in &mut bodies {
        if !displayed.is_behind(fraction) {
            continue;
        }
        displayed.interpolate(fraction);
        if let Some([from, to]) = displayed.poses
            // If the transform was changed from outside, the next tick applies that change instead.
            && state.is_placed(&transform.compute_affine())
        {
            transform.translation = from.origin.lerp(to.origin, fraction).as_vec3();
            transform.rotation = from.orientation.slerp(to.orientation, fraction).normalize().as_quat();
            // This keeps the body from treating its own change as a change from outside.
            state.placed = Some(transform.compute_affine());
        }
    }
}
