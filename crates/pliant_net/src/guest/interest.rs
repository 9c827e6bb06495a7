//! Subscriptions: how much of each body a guest requests. A body that is out of view or far away
//! needs less data.

use std::time::Duration;

use bevy::camera::primitives::{Frustum, Sphere};
use bevy::math::Vec3A;
use bevy::prelude::*;
use pliant_body::{BodyState, Grabs};

use super::NetGuest;
use crate::remote::RemoteBody;

/// How much of a body the host sends to a guest. Every body that tracks a host's body has it. The
/// app writes it, or [`CameraInterest`] does.
///
/// Fewer modes need fewer bytes and less work, and give a coarser shape. Modes are ordered: the
/// first are the largest motions. A body with reduced elasticity hardly bends without its last
/// coordinates, so all of these come, refreshed the more rarely.
#[derive(Component, Reflect, Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
#[reflect(Component, Default, Clone, PartialEq)]
pub enum Interest {
    /// All modes that this guest accepts. Default.
    #[default]
    All,
    /// This number of modes, rounded up to the next of 1, 2, 3, 4, 6, 8, 12 and so on. It is at
    /// least one, and no more than this guest accepts.
    Modes(u16),
    /// No modes: the body keeps its last displayed state.
    Nothing,
}

/// Requests only what the cameras see.
///
/// A body outside all views gets no modes, and a small body gets half, a quarter or an eighth of
/// its modes, but at least four. A request for more modes is sent at once, a request for fewer
/// modes only after `patience`. A body that this guest holds gets all modes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraInterest {
    /// A body whose height is at least this part of the view's height gets all modes. Default:
    /// 0.15.
    pub whole: f32,
    /// How long fewer modes must have been enough before fewer are requested. Default: 1 s.
    pub patience: Duration,
}

impl Default for CameraInterest {
    fn default() -> Self {
        Self { whole: 0.15, patience: Duration::from_secs(1) }
    }
}

impl CameraInterest {
    /// Returns the interest in a body with this number of modes, whose height is the part `height`
    /// of the view's height (`None`: out of view).
    fn worth(&self, height: Option<f32>, modes: usize) -> Interest {
        let Some(height) = height else { return Interest::Nothing };
        let share = [(1.0, 1), (0.5, 2), (0.25, 4)].into_iter().find(|(part, _)| height >= self.whole * part);
        match share.map_or(8, |(_, share)| share) {
            1 => Interest::All,
            share => Interest::Modes(u16::try_from(modes.div_ceil(share).max(4)).unwrap_or(u16::MAX)),
        }
    }
}

impl Interest {
    /// The limit that is sent; `None` for no limit.
    fn modes(self) -> Option<u16> {
        match self {
            Self::All => None,
            Self::Modes(modes) => Some(modes.max(1)),
            Self::Nothing => Some(0),
        }
    }

    /// Whether this asks for less than another interest does.
    fn is_less_than(self, other: Self) -> bool {
        let most = |interest: Self| interest.modes().map_or(u32::MAX, u32::from);
        most(self) < most(other)
    }
}

/// `PostUpdate`: sets the interests from the cameras, if [`CameraInterest`] is on, and sends those
/// that have changed to the host.
pub(crate) fn send_interest(
    guest: Option<ResMut<NetGuest>>,
    cameras: Query<(&Camera, &Projection, &GlobalTransform, &Frustum)>,
    mut bodies: Query<(&RemoteBody, &mut Interest, Option<(&BodyState, &GlobalTransform)>, Option<&Grabs>)>,
) {
    let Some(mut guest) = guest else { return };
    let now = guest.now();
    for (body, mut interest, there, grabs) in &mut bodies {
        let (Some(config), Some((state, place))) = (guest.config.interest, there) else { continue };
        let model = state.model();
        let (scale, ..) = place.to_scale_rotation_translation();
        let radius = 0.5 * model.size() as f32 * scale.x;
        let [low, high] = model.surface().bounds();
        let middle = place.transform_point(0.5 * (Vec3::from(low) + Vec3::from(high)));
        let heights =
            cameras.iter().filter(|(camera, ..)| camera.is_active).filter_map(|(_, lens, at, frustum)| {
                // A bent body leaves its bounds at rest.
                let seen = Sphere { center: Vec3A::from(middle), radius: 1.5 * radius };
                frustum
                    .intersects_sphere(&seen, true)
                    .then(|| height_in(lens, at.translation().distance(middle), radius))
            });
        let held = grabs.is_some_and(|grabs| !grabs.entities().is_empty());
        let highest = heights.reduce(f32::max);
        let worth = if held { Interest::All } else { config.worth(highest, model.mode_count()) };
        let waits = worth.is_less_than(*interest) && {
            let since = *guest.less_since.entry(body.0).or_insert(now);
            now.saturating_sub(since) < config.patience
        };
        if !waits {
            guest.less_since.remove(&body.0);
            interest.set_if_neq(worth);
        }
    }
    let Some(session) = &mut guest.session else { return };
    for (body, interest, ..) in &bodies {
        session.set_interest(body.0, interest.modes());
    }
}

/// Returns the part of the view's height that a sphere takes.
fn height_in(lens: &Projection, distance: f32, radius: f32) -> f32 {
    match lens {
        Projection::Perspective(lens) => radius / (distance.max(1e-6) * (0.5 * lens.fov).tan()),
        Projection::Orthographic(lens) => 2.0 * radius / lens.area.height().max(1e-6),
        // The size under an unknown projection is unknown, so all modes are requested.
        Projection::Custom(_) => f32::INFINITY,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_bodies_are_worth_fewer_modes_and_unseen_ones_none() {
        let config = CameraInterest::default();
        assert_eq!(config.worth(None, 60), Interest::Nothing);
        assert_eq!(config.worth(Some(0.2), 60), Interest::All);
        assert_eq!(config.worth(Some(0.1), 60), Interest::Modes(30));
        assert_eq!(config.worth(Some(0.05), 60), Interest::Modes(15));
        assert_eq!(config.worth(Some(0.001), 60), Interest::Modes(8));
        assert_eq!(config.worth(Some(0.001), 10), Interest::Modes(4), "never fewer");
    }

    #[test]
    fn a_sphere_takes_its_part_of_the_view() {
        let lens = Projection::Perspective(PerspectiveProjection {
            fov: std::f32::consts::FRAC_PI_2,
            ..PerspectiveProjection::default()
        });
        // The view is 2 m high at a distance of 1 m, and a ball of 0.5 m diameter is a quarter of
        // it.
        assert!((height_in(&lens, 1.0, 0.25) - 0.25).abs() < 1e-6);
        assert!((height_in(&lens, 10.0, 0.25) - 0.025).abs() < 1e-6);
    }
}
