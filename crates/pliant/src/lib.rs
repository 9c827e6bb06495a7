//! Soft bodies that several people hold, feel and watch at once, over networks that lose packets.
//!
//! ```no_run
//! use bevy::prelude::*;
//! use pliant::prelude::*;
//!
//! fn main() {
//!     App::new().add_plugins((DefaultPlugins, PliantPlugins::default())).add_systems(Startup, setup).run();
//! }
//!
//! fn setup(mut commands: Commands, assets: Res<AssetServer>) {
//!     commands.spawn((ModalBody::new(assets.load("pip.modal")), Transform::from_xyz(0.0, 0.5, 0.0)));
//!     commands.spawn((Camera3d::default(), Transform::from_xyz(0.0, 1.0, 3.0).looking_at(Vec3::Y, Vec3::Y)));
//! }
//! # #[cfg(not(feature = "render"))] #[derive(Component, Default)] struct Camera3d;
//! ```
//!
//! # Plugins
//!
//! [`PliantPlugins`] adds what nearly every scene needs:
//!
//! | Plugin | What it does | Without it |
//! | --- | --- | --- |
//! | [`PliantBodyPlugin`](body::PliantBodyPlugin) | `.modal` assets, [`ModalBody`](body::ModalBody), grabs, the fixed step, the deformed surface | no other plugin works |
//! | [`RidingPlugin`](body::RidingPlugin) | bodies feel how their entities move, ride on bones and carry things | nothing rides |
//! | [`PointerGrabPlugin`](body::PointerGrabPlugin) | pointers drag bodies (feature `picking`) | only code makes grabs |
#![cfg_attr(
    feature = "contact",
    doc = "| [`ContactPlugin`](contact::ContactPlugin) | bodies touch floors, balls, boxes, capsules and meshes (feature `contact`) | bodies touch nothing |"
)]
#![cfg_attr(
    all(feature = "panel", feature = "rerun"),
    doc = "| [`RecordingPanelPlugin`] | the live panel shows the recording (features `panel` and `rerun`) | the panel has no such section |"
)]
//!
//! These plugins are added where they are needed, each behind its feature:
//!
//! | Plugin | Feature | What it does |
//! | --- | --- | --- |
#![cfg_attr(
    feature = "rerun",
    doc = "| [`RerunPlugin`](rerun::RerunPlugin) | `rerun` | shapes, forces and figures to the rerun viewer or a file |"
)]
#![cfg_attr(
    feature = "net",
    doc = "| the plugins of [`net`] | `net` | one body held by several machines, over QUIC |"
)]
#![cfg_attr(
    feature = "haptics",
    doc = "| [`HapticsPlugin`](haptics::HapticsPlugin) | `haptics` | haptic devices, the tools they move and the forces they give |"
)]
#![cfg_attr(
    feature = "bake",
    doc = "| [`BakePlugin`](body::BakePlugin) | `bake` | surfaces and descriptions become bodies in the game, beside its frames |"
)]
//!
//! A scene can also be a file: [`scene`] reads bodies, hands, a session, a device and a recording
//! from a `.ron` file.
//!
//! # Features
//!
//! | Feature | Default | What it adds |
//! | --- | --- | --- |
//! | `render` | yes | Bevy's renderer, which draws the bodies |
//! | `picking` | yes | Bevy's picking, with which pointers drag the bodies |
//! | `contact` | no | obstacles that bodies touch, and bodies that touch each other |
//! | `contact-mesh` | no | convex hulls and triangle meshes as obstacles |
//! | `contact-avian` | no | colliders and rigid bodies of avian3d 0.7, with forces both ways, and attachments to them |
//! | `net` | no | sessions over QUIC |
//! | `states` | no | the state of the session as a state of Bevy, with `net` |
//! | `watch` | no | sessions for watchers without number, over relays, with `net` |
//! | `haptics` | no | haptic devices and the device loop |
//! | `rerun` | no | the client of the rerun viewer |
//! | `panel` | no | the live panel (egui) |
//! | `bake` | no | meshing and baking inside the game |
//!
//! None of them asks Bevy for a window, a user interface, threads (`multi_threaded`) or types that
//! register themselves (`reflect_auto_register`). These are the game's to choose.

#![cfg_attr(docsrs, feature(doc_cfg))]
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

use bevy::{
    app::{PluginGroup, PluginGroupBuilder},
    ecs::schedule::{InternedScheduleLabel, ScheduleLabel},
    prelude::FixedUpdate,
};

#[cfg(feature = "bake")]
pub use pliant_bake as bake;
pub use pliant_body as body;
#[cfg(feature = "contact")]
pub use pliant_contact as contact;
#[cfg(feature = "haptics")]
pub use pliant_haptics as haptics;
#[cfg(feature = "bake")]
pub use pliant_mesh as mesh;
pub use pliant_modal as modal;
#[cfg(feature = "net")]
pub use pliant_net as net;
#[cfg(feature = "panel")]
pub use pliant_panel as panel;
#[cfg(feature = "rerun")]
pub use pliant_rerun as rerun;
#[cfg(feature = "net")]
pub use pliant_stream as stream;

#[cfg(all(feature = "panel", feature = "rerun"))]
mod recording_panel;
pub mod scene;

#[cfg(all(feature = "panel", feature = "rerun"))]
pub use recording_panel::RecordingPanelPlugin;

/// The plugins that a scene with soft bodies needs.
///
/// The [crate page](crate#plugins) lists the plugins of the group and those that can be added.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant::prelude::*;
/// # let mut app = App::new();
/// # app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin));
/// // Stepped in `FixedPostUpdate`, and nothing for the pointer to hold.
/// app.add_plugins(PliantPlugins::new(FixedPostUpdate).build().disable::<PointerGrabPlugin>());
/// ```
pub struct PliantPlugins {
    schedule: InternedScheduleLabel,
}

impl PliantPlugins {
    /// Creates the group with bodies that are stepped in `schedule`.
    ///
    /// In the fixed loop, the steps have a fixed length and the visual state is interpolated
    /// between them. In any other schedule, such as `Update`, a step is as long as the frame.
    pub fn new(schedule: impl ScheduleLabel) -> Self {
        Self { schedule: schedule.intern() }
    }
}

impl Default for PliantPlugins {
    /// Steps the bodies in `FixedUpdate`.
    fn default() -> Self {
        Self::new(FixedUpdate)
    }
}

impl PluginGroup for PliantPlugins {
    fn build(self) -> PluginGroupBuilder {
        let group = PluginGroupBuilder::start::<Self>()
            .add(body::PliantBodyPlugin::new(self.schedule))
            .add(body::RidingPlugin::new(self.schedule));
        #[cfg(feature = "picking")]
        let group = group.add(body::PointerGrabPlugin);
        #[cfg(feature = "contact")]
        let group = group.add(contact::ContactPlugin::new(self.schedule));
        #[cfg(all(feature = "panel", feature = "rerun"))]
        let group = group.add(RecordingPanelPlugin);
        group
    }
}

/// The names that a scene uses.
pub mod prelude {
    pub use crate::PliantPlugins;
    pub use crate::body::{
        BodyGravity, BodyGravityScale, BodyReady, BodyRefused, BodyState, Driven, Grab, GrabForce, GrabOf,
        Grabbed, Grabs, Impulse, Inertia, Integrator, ModalAsset, ModalBody, NoPointerGrab, PliantBodyPlugin,
        PliantDisplaySystems, PliantSystems, PliantTick, ProbeShape, ProbeState, Push, Relaxation, Released,
        RideOn, RidingPlugin, SingleSteps, StepSettings, SurfaceAnchor, SurfacePlace, Teleport, TouchProbe,
        VisualState,
    };
    #[cfg(feature = "render")]
    pub use crate::body::{PliantGizmos, SurfaceDeformation, SurfaceDetail, SurfaceShading};
    #[cfg(feature = "picking")]
    pub use crate::body::{PointerGrab, PointerGrabPlugin, PointerGrabSystems, PointerHeld};
    #[cfg(feature = "contact-avian")]
    pub use crate::contact::{Attachment, AttachmentForce};
    #[cfg(feature = "contact")]
    pub use crate::contact::{
        BodyContacts, BodyFriction, ContactEnded, ContactLayers, ContactPlugin, ContactStarted, Obstacle,
        TouchBodies,
    };
    #[cfg(all(feature = "haptics", feature = "render"))]
    pub use crate::haptics::ForceArrow;
    #[cfg(feature = "haptics")]
    pub use crate::haptics::{
        HapticButton, HapticDevices, HapticFault, HapticNotice, HapticTool, HapticsPlugin, ToolGrabs,
        ToolGrip, ToolOffset, ToolPose, ToolTouch,
    };
    pub use crate::modal::{ModalModel, Patch};
    #[cfg(feature = "watch")]
    pub use crate::net::watch::{WatchCommands, WatchPlugin, WatchView};
    #[cfg(feature = "net")]
    pub use crate::net::{SessionCommands, SessionState};
}

/// Compiles the code of the README.
#[cfg(all(doctest, feature = "render", feature = "net", feature = "haptics"))]
#[doc = include_str!("../../../README.md")]
pub struct Readme;

/// Compiles the code of the book, and runs the blocks that are not marked `no_run`.
#[cfg(all(
    doctest,
    feature = "render",
    feature = "net",
    feature = "haptics",
    feature = "rerun",
    feature = "panel",
    feature = "contact-mesh",
    feature = "contact-avian",
    feature = "bake"
))]
pub mod book {
    #[doc = include_str!("../../../docs/concepts.md")]
    pub struct ConceptsPage;
    #[doc = include_str!("../../../docs/first-scene.md")]
    pub struct FirstScenePage;
    #[doc = include_str!("../../../docs/baking.md")]
    pub struct BakingPage;
    #[doc = include_str!("../../../docs/blender.md")]
    pub struct BlenderPage;
    #[doc = include_str!("../../../docs/contact.md")]
    pub struct ContactPage;
    #[doc = include_str!("../../../docs/multiuser.md")]
    pub struct MultiuserPage;
    #[doc = include_str!("../../../docs/devices.md")]
    pub struct DevicesPage;
    #[doc = include_str!("../../../docs/recording.md")]
    pub struct RecordingPage;
    #[doc = include_str!("../../../docs/performance.md")]
    pub struct PerformancePage;
    #[doc = include_str!("../../../docs/limits.md")]
    pub struct LimitsPage;
}
