//! The plugin for what rides: bodies on moving entities, and entities on bodies.

use bevy::{
    ecs::schedule::{InternedScheduleLabel, ScheduleLabel},
    prelude::*,
    transform::TransformSystems,
};

use crate::{
    Inertia, PliantDisplaySystems, PliantSystems, RideOn, SurfaceAnchor, Teleport, inertia, is_fixed,
    ride_on, step, surface_anchor,
};

/// Lets bodies feel how their entities move ([`Inertia`]), ride on bones ([`RideOn`]), and carry
/// what sits on their surface ([`SurfaceAnchor`]).
///
/// The plugin needs [`PliantBodyPlugin`](crate::PliantBodyPlugin) in the same schedule. Without it
/// these components have no effect, and a scene has none of their systems.
pub struct RidingPlugin {
    schedule: InternedScheduleLabel,
}

impl RidingPlugin {
    /// Follows bodies that are stepped in `schedule`.
    pub fn new(schedule: impl ScheduleLabel) -> Self {
        Self { schedule: schedule.intern() }
    }
}

impl Default for RidingPlugin {
    /// Follows bodies that are stepped in `FixedUpdate`.
    fn default() -> Self {
        Self::new(FixedUpdate)
    }
}

impl Plugin for RidingPlugin {
    fn build(&self, app: &mut App) {
        app.register_type::<Inertia>()
            .register_type::<Teleport>()
            .register_type::<RideOn>()
            .register_type::<SurfaceAnchor>()
            .add_message::<Teleport>()
            .add_systems(
                self.schedule,
                inertia::ride
                    .after(step::place_bodies)
                    .before(step::hold_bodies)
                    .in_set(PliantSystems::Input),
            )
            .add_systems(PreUpdate, inertia::forget_paused)
            .add_systems(
                PostUpdate,
                (ride_on::find_parents, surface_anchor::place_on_surfaces)
                    .chain()
                    .after(PliantDisplaySystems::Interpolate)
                    .before(TransformSystems::Propagate),
            );
        if is_fixed(self.schedule) {
            app.add_systems(FixedPreUpdate, inertia::begin_tick).add_systems(FixedLast, inertia::end_tick);
        }
    }
}
