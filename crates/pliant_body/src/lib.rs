//! The Bevy plugin for modal soft bodies.
//!
//! The plugin provides assets, components, fixed-step systems, grabs, pointer dragging and the
//! deformed surface.
//!
//! ```no_run
//! use bevy::prelude::*;
//! use pliant_body::{ModalBody, PliantBodyPlugin};
//!
//! fn main() {
//!     App::new().add_plugins((DefaultPlugins, PliantBodyPlugin::default())).add_systems(Startup, setup).run();
//! }
//!
//! fn setup(mut commands: Commands, assets: Res<AssetServer>) {
//!     commands.spawn(ModalBody::new(assets.load("pip.modal")));
//! }
//! ```
//!
//! | Written by you | Read by you |
//! | --- | --- |
//! | [`ModalBody`]: the model and its step settings | [`BodyState`]: the simulated body |
//! | `Transform`: the body's position, rotation and scale | [`VisualState`]: the state on screen |
//! | [`Grab`] and [`GrabOf`] on a separate entity: a grab of a patch | [`GrabForce`]: the reaction, N; [`Grabs`] on the body |
//! | [`Impulse`], [`Push`] as messages: an impulse, N s; a force for one tick, N | [`BodyState::body`]: the result |
//! | [`BodyGravity`] as a resource, [`BodyGravityScale`]: gravity of the scene, and a body's factor | |
//! | [`Inertia`], [`RideOn`]: how strongly it feels its entity move, and a bone that it rides on | |
//! | [`SurfaceAnchor`] on another entity: it sits on the surface | its `Transform` |
//! | [`Driven::Remote`]: another source moves the body | [`PliantTick`]: the number of the step |
//! | `SurfaceShading`, `SurfaceDetail`, `SurfaceDeformation`, `SurfacePart`: sharp edges, level of detail, GPU or CPU, several materials (feature `render`) | [`BodyReady`], [`Grabbed`], [`Released`], [`BodyRefused`]: events on the body for observers; the last has a refused input with its error |
//!
//! The crate does not depend on a network, a device, a viewer or a panel. Those crates depend on
//! this one. The bodies follow Bevy's time: pausing `Time<Virtual>` pauses them, and
//! [`SingleSteps`] runs single steps during the pause.
//!
//! # Features
//!
//! `render`: draws the deformed surface as a mesh with normals, and draws the pointer's target.
//! Without this feature no renderer is compiled.
//!
//! `bake`: adds `BakePlugin`, which meshes and bakes bodies inside the game from a `BakeRequest`
//! or a `BakeNode`, and bakes files when assets are processed.
//! Without this feature bodies are loaded from `.modal` files and no part of the bake is compiled.
#![cfg_attr(docsrs, feature(doc_cfg))]
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod asset;
#[cfg(feature = "bake")]
mod bake;
mod body;
#[cfg(feature = "render")]
mod deform;
mod error;
mod grab;
mod gravity;
mod held;
mod impulse;
mod inertia;
mod mesh_triangles;
mod pause;
mod pick;
#[cfg(feature = "picking")]
mod picking;
#[cfg(feature = "picking")]
mod pointer;
mod probe;
mod ride_on;
mod riding;
mod saved;
mod step;
mod step_times;
mod surface_anchor;
mod surroundings;
#[cfg(test)]
mod tests;
mod visual;

use bevy::{
    asset::AssetEventSystems,
    diagnostic::{Diagnostic, DiagnosticPath, RegisterDiagnostic},
    ecs::schedule::{InternedScheduleLabel, ScheduleLabel},
    prelude::*,
};

pub use asset::{ModalAsset, ModalAssetError, ModalAssetLoader};
#[cfg(feature = "bake")]
pub use bake::{
    ATTRIBUTE_ANCHOR, ATTRIBUTE_DENSITY, ATTRIBUTE_STIFFNESS, BakeBodyError, BakeExtrasError, BakeFailed,
    BakeNode, BakePlugin, BakeProcessor, BakeProgress, BakeRequest, BakeSettings, BakeShape, BakeSkin,
    BakeStage, Bakery,
};
pub use body::{BodyReady, BodyState, Driven, ModalBody, ModalBodyTemplate, NoPointerGrab};
#[cfg(feature = "render")]
pub use deform::{DrawnSurface, SurfaceDeformation, SurfaceDetail, SurfacePart, SurfaceShading};
pub use error::{BodyError, BodyRefused};
pub use grab::{Grab, GrabForce, GrabOf, Grabbed, Grabs, Released};
pub use gravity::{BodyGravity, BodyGravityScale};
pub use held::HeldShapesCache;
pub use impulse::{Impulse, Push};
pub use inertia::{Inertia, Teleport};
pub use mesh_triangles::MeshTriangles;
pub use pause::SingleSteps;
pub use pick::{SurfaceHit, pick_surface};
pub use pliant_modal::{Elasticity, Integrator, Material, Relaxation, StepSettings};
#[cfg(feature = "picking")]
pub use pointer::{PointerGrab, PointerGrabPlugin, PointerGrabSystems, PointerHeld};
pub use probe::{ProbeShape, ProbeState, TouchProbe, Touching};
pub use ride_on::RideOn;
pub use riding::RidingPlugin;
pub use saved::SavedState;
pub use step::{PliantTick, RigidBodies};
pub use step_times::BodyStepTimes;
pub use surface_anchor::{SurfaceAnchor, SurfacePlace};
pub use surroundings::FixedObstacles;
pub use visual::{Pose, VisualState};

/// Diagnostic: time of one tick's steps of all awake bodies, ms.
pub const STEP_TIME: DiagnosticPath = DiagnosticPath::const_new("pliant/step");

/// Diagnostic: number of bodies stepped in a tick.
pub const AWAKE_BODIES: DiagnosticPath = DiagnosticPath::const_new("pliant/awake");

/// Diagnostic: time of updating the surfaces that changed in a frame, ms (feature `render`).
pub const DEFORM_TIME: DiagnosticPath = DiagnosticPath::const_new("pliant/deform");

/// The system sets of a tick, in this order, in the schedule given to [`PliantBodyPlugin`].
///
/// No set runs while the schedule's time stands still.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub enum PliantSystems {
    /// Reads transforms, grabs, impulses and forces. A script or a session that moves a [`Grab`] or
    /// writes an [`Impulse`] or a [`Push`] once per tick must run before this set.
    Input,
    /// Steps the local bodies.
    Step,
    /// Writes [`VisualState`] and [`GrabForce`]. Sources of remote bodies call
    /// [`VisualState::push`] in this set. Systems that read the results run after this set.
    Publish,
}

/// The system sets of a frame, in this order, in `PostUpdate`.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub enum PliantDisplaySystems {
    /// Interpolates the visual states to this frame's time between two ticks.
    Interpolate,
    /// Updates the surfaces from the visual states.
    Deform,
}

/// Adds bodies, grabs and, with the feature `render`, their surfaces.
///
/// The plugin needs Bevy's asset, time and transform plugins. `DefaultPlugins` contains them. A
/// headless app needs `MinimalPlugins`, `AssetPlugin` and `TransformPlugin`.
///
/// With the feature `picking` the bodies are a backend of Bevy's picking. They receive the events
/// ([`bevy::picking::events::Pointer`]) of the mouse, of touches and of every other pointer, and
/// [`bevy::picking::Pickable`] works as for any entity. A hit is tested against the deformed
/// surface as it is drawn. The hit carries the point and the normal, world axes, and as
/// [`extra_as`](bevy::picking::backend::HitData::extra_as) the [`SurfaceHit`] in the
/// body's axes. A camera picks the bodies whose render layers it shares. Hidden bodies and bodies
/// with [`NoPointerGrab`] are not picked. The cost of a frame is one test of a box for each pair of
/// a pointer's ray and a body. A body whose box is hit adds one reconstruction of its surface on
/// the processor and one pass over its triangles. Without Bevy's `PickingPlugin` there is no cost.
pub struct PliantBodyPlugin {
    schedule: InternedScheduleLabel,
}

impl PliantBodyPlugin {
    /// Steps the bodies in `schedule`, with that schedule's time step.
    ///
    /// In a schedule of the fixed loop (`FixedUpdate` and its neighbors) the visual states are
    /// interpolated between steps. In any other schedule (`Update`) the step is as long as the
    /// frame.
    pub fn new(schedule: impl ScheduleLabel) -> Self {
        Self { schedule: schedule.intern() }
    }
}

impl Default for PliantBodyPlugin {
    /// Steps the bodies in `FixedUpdate`.
    fn default() -> Self {
        Self::new(FixedUpdate)
    }
}

/// The gizmos of Pliant: targets of pointers, forces of tools. Change or switch them off with
/// Bevy's `GizmoConfigStore`.
#[cfg(feature = "render")]
#[derive(Reflect, Debug, Default, GizmoConfigGroup)]
#[reflect(Debug, Default)]
pub struct PliantGizmos;

/// Returns whether a schedule belongs to the fixed loop.
#[doc(hidden)]
pub fn is_fixed(schedule: InternedScheduleLabel) -> bool {
    [
        FixedFirst.intern(),
        FixedPreUpdate.intern(),
        FixedUpdate.intern(),
        FixedPostUpdate.intern(),
        FixedLast.intern(),
    ]
    .contains(&schedule)
}

impl Plugin for PliantBodyPlugin {
    fn build(&self, app: &mut App) {
        #[cfg(feature = "picking")]
        picking::build(app);
        let fixed = is_fixed(self.schedule);
        saved::register(app);
        app.init_asset::<ModalAsset>()
            .register_asset_reflect::<ModalAsset>()
            .init_asset_loader::<ModalAssetLoader>()
            .register_type::<ModalBody>()
            .register_type::<BodyGravity>()
            .register_type::<BodyGravityScale>()
            .register_type::<Driven>()
            .register_type::<NoPointerGrab>()
            .register_type::<Grab>()
            .register_type::<GrabOf>()
            .register_type::<Grabs>()
            .register_type::<GrabForce>()
            .register_type::<Pose>()
            .register_type::<PliantTick>()
            .register_type::<VisualState>()
            .register_type::<BodyRefused>()
            .register_type::<BodyReady>()
            .register_type::<Grabbed>()
            .register_type::<Released>()
            .register_type::<SingleSteps>()
            .register_type::<Impulse>()
            .register_type::<Push>()
            .register_type::<TouchProbe>()
            .register_type::<ProbeShape>()
            .add_message::<SingleSteps>()
            .add_message::<Impulse>()
            .add_message::<Push>()
            .init_resource::<BodyGravity>()
            .init_resource::<PliantTick>()
            .init_resource::<HeldShapesCache>()
            .insert_resource(step::Stepping { fixed })
            .register_diagnostic(Diagnostic::new(STEP_TIME).with_suffix(" ms"))
            .register_diagnostic(Diagnostic::new(AWAKE_BODIES))
            .register_diagnostic(Diagnostic::new(DEFORM_TIME).with_suffix(" ms"))
            .add_observer(step::drop_states)
            .add_observer(step::clear_grab_force)
            .add_observer(step::lose_body)
            .configure_sets(
                self.schedule,
                (PliantSystems::Input, PliantSystems::Step, PliantSystems::Publish)
                    .chain()
                    .run_if(|time: Res<Time>| !time.delta().is_zero()),
            )
            .configure_sets(
                PostUpdate,
                (
                    PliantDisplaySystems::Interpolate.before(TransformSystems::Propagate),
                    PliantDisplaySystems::Deform.before(AssetEventSystems),
                )
                    .chain(),
            )
            .add_systems(
                self.schedule,
                (
                    (
                        step::count_tick,
                        visual::begin_tick,
                        step::place_bodies,
                        gravity::pull_bodies,
                        step::hold_bodies,
                        held::shape_held,
                        impulse::hit_bodies,
                    )
                        .chain()
                        .in_set(PliantSystems::Input),
                    step::step_bodies.in_set(PliantSystems::Step),
                    step::publish.in_set(PliantSystems::Publish),
                ),
            )
            .add_systems(PreUpdate, pause::single_steps)
            .add_systems(
                PostUpdate,
                (
                    visual::interpolate.in_set(PliantDisplaySystems::Interpolate),
                    // This runs after transform propagation, so that no body is stepped with an
                    // outdated transform.
                    step::build_bodies
                        .after(TransformSystems::Propagate)
                        .before(PliantDisplaySystems::Deform),
                ),
            );
        #[cfg(feature = "render")]
        deform::build(app);
    }

    #[cfg(feature = "render")]
    fn finish(&self, app: &mut App) {
        if app.is_plugin_added::<bevy::gizmos::GizmoPlugin>() {
            app.init_gizmo_group::<PliantGizmos>();
        }
        deform::finish(app);
    }
}
