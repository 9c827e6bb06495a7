//! Tests that what users meet is data as Bevy has it: registered for reflection, so that it can be
//! saved, cloned, looked at in an inspector and named in a scene.

use std::{fs, path::Path};

use bevy::{
    app::{App, MainSchedulePlugin},
    ecs::{
        reflect::{AppTypeRegistry, ReflectComponent, ReflectResource},
        schedule::ScheduleLabel,
    },
    prelude::*,
    reflect::{ReflectFromReflect, prelude::ReflectDefault},
    transform::TransformPlugin,
};
use pliant::{
    body::{BakePlugin, ModalBodyTemplate},
    net::{HostConfig, NetPlugin},
    prelude::*,
};

const CRATES: [&str; 4] = ["pliant_body", "pliant_contact", "pliant_net", "pliant_haptics"];

/// The public components and resources that are not registered, and why.
const WITHOUT: [(&str, &str); 16] = [
    ("BakeRequest", "may hold code of the game, which cannot be saved"),
    ("Bakery", "bakes that are running"),
    ("BodyState", "a solver that runs; a saved world has SavedState in its place"),
    ("BodyStepTimes", "what the newest tick took"),
    ("CarrierPort", "open connections"),
    ("DrawnSurface", "what is on the graphics card"),
    ("FixedObstacles", "what a session asks when it begins; the next one asks anew"),
    ("GamepadSource", "a handle of a running device"),
    ("HapticDevices", "running devices with their threads"),
    ("HeldShapesCache", "a cache, which is made again"),
    ("NetGuest", "open connections"),
    ("NetHost", "open connections"),
    ("NetPeer", "open connections"),
    ("ProbeState", "a solver that runs; it is made again from its TouchProbe"),
    ("PointerSource", "a handle of a running device"),
    ("RigidBodies", "what a tick sees of another engine's bodies"),
];

/// The same for what is left: `Rumble` has the channel to the gamepads.
const CHANNEL: &str = "Rumble";

/// Returns an app with all plugins, whose types are those that the plugins register. Types that
/// derive `Reflect` are not there by themselves, as in a game without `reflect_auto_register`.
fn app() -> App {
    let mut app = App::empty();
    app.main_mut().update_schedule = Some(Main.intern());
    app.init_resource::<AppTypeRegistry>().add_plugins(MainSchedulePlugin).add_message::<AppExit>();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin)).add_plugins((
        PliantPlugins::default(),
        HapticsPlugin::default(),
        NetPlugin::host(HostConfig::default()).unwrap(),
        BakePlugin { cache: None },
        WatchPlugin,
    ));
    app
}

/// The names of the public types in a crate's sources that derive `what`.
fn deriving(folder: &Path, what: &str, found: &mut Vec<String>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            if path.file_name().unwrap() != "tests" {
                deriving(&path, what, found);
            }
            continue;
        }
        let text = fs::read_to_string(&path).unwrap();
        let text = text.split("\n#[cfg(test)]").next().unwrap();
        for derive in text.split("\n#[derive(").skip(1) {
            let (list, rest) = derive.split_once(")]").unwrap();
            let derives = list.split(',').any(|name| name.trim() == what);
            let line = rest.lines().find(|line| line.starts_with("pub")).unwrap_or_default();
            let name = line.strip_prefix("pub struct ").or(line.strip_prefix("pub enum "));
            if let (true, Some(name)) = (derives, name) {
                let end = name.find(|c: char| !c.is_alphanumeric()).unwrap_or(name.len());
                found.push(name[..end].to_owned());
            }
        }
    }
}

#[test]
fn every_public_component_and_resource_is_registered() {
    let app = app();
    let registry = app.world().resource::<AppTypeRegistry>().read();
    let mut missing = Vec::new();
    let mut seen = 0;
    let mut unused: Vec<&str> = WITHOUT.iter().map(|(name, _)| *name).chain([CHANNEL]).collect();
    for krate in CRATES {
        let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates").join(krate).join("src");
        for kind in ["Component", "Resource", "Message", "EntityEvent", "Asset"] {
            let mut names = Vec::new();
            deriving(&sources, kind, &mut names);
            for name in names {
                seen += 1;
                if unused.contains(&name.as_str()) {
                    unused.retain(|other| *other != name);
                    continue;
                }
                let end = format!("::{name}");
                let of_crate = |path: &str| path.starts_with(krate) && path.ends_with(&end);
                let found = registry.iter().find(|kind| of_crate(kind.type_info().type_path()));
                let sound = found.is_some_and(|found| match kind {
                    "Component" | "Resource" => {
                        (kind == "Component" || found.contains::<ReflectResource>())
                            && found.contains::<ReflectComponent>()
                            && found.contains::<ReflectFromReflect>()
                            // An inspector adds them, and a saved world may leave out a field.
                            && found.contains::<ReflectDefault>()
                    }
                    _ => true,
                });
                if !sound {
                    missing.push(format!("{krate}: {kind} {name}"));
                }
            }
        }
    }
    assert!(missing.is_empty(), "not registered: {missing:#?}");
    assert!(unused.is_empty(), "these are no types any more: {unused:?}");
    assert!(seen > 50, "{seen} types: the sources are read wrongly");
}

#[test]
fn a_scene_in_bevys_notation_names_a_model_by_its_path() {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin, bevy::scene::ScenePlugin))
        .add_plugins(PliantPlugins::default());
    let scene = bsn! {
        #Body
        ModalBody { model: "pip.modal", rest_speed: 0.5 }
        Children [ (Obstacle::Ball { radius: 0.25 }), (RideOn { root: #Body, name: "Head" }) ]
    };
    let body = app.world_mut().spawn_scene(scene).unwrap().id();
    let world = app.world();
    let made = world.get::<ModalBody>(body).unwrap();
    let path = made.model.path().map(ToString::to_string);
    assert_eq!((path.as_deref(), made.rest_speed), (Some("pip.modal"), 0.5));
    // What the scene does not name is as by `ModalBody::default()`.
    let default = ModalBody::default();
    assert_eq!(*made, ModalBody { model: made.model.clone(), rest_speed: 0.5, ..default });
    assert_eq!(ModalBodyTemplate::default().rest_speed, ModalBody::default().rest_speed);
    let children: Vec<Entity> = world.get::<Children>(body).unwrap().iter().collect();
    assert_eq!(world.get::<Obstacle>(children[0]), Some(&Obstacle::Ball { radius: 0.25 }));
    assert_eq!(world.get::<RideOn>(children[1]).unwrap().root, body);
}

/// Bevy's prelude and ours, as a game imports them.
mod both {
    #[expect(unused_imports, reason = "that no name is taken from it is the test")]
    pub use bevy::prelude::*;
    pub use pliant::prelude::*;
}

/// Imports each name out of both preludes: one that both have does not compile.
macro_rules! import {
    ($($name:ident),* $(,)?) => {
        mod import {
            #![expect(unused_imports, reason = "that they can be imported is the test")]
            use super::both::{$($name),*};
        }
        const NAMES: &[&str] = &[$(stringify!($name)),*];
    };
}

import! {
    Attachment, AttachmentForce, BodyContacts, BodyFriction, BodyGravity, BodyGravityScale, BodyReady,
    BodyRefused, BodyState, ContactEnded, ContactLayers, ContactPlugin, ContactStarted, Driven, ForceArrow, Grab,
    GrabForce, GrabOf, Grabbed, Grabs, HapticButton, HapticDevices,
    HapticFault, HapticNotice, HapticTool, HapticsPlugin, Impulse, Inertia,
    Integrator, ModalAsset, ModalBody, ModalModel, NoPointerGrab, Obstacle,
    Patch, PliantBodyPlugin, PliantDisplaySystems, PliantGizmos, PliantPlugins, PliantSystems,
    PliantTick, PointerGrab, PointerGrabPlugin, PointerGrabSystems, PointerHeld, ProbeShape, ProbeState,
    Push,
    Relaxation, Released, RideOn, RidingPlugin, SessionCommands, SessionState, SingleSteps, StepSettings,
    SurfaceAnchor, SurfaceDeformation, SurfaceDetail, SurfacePlace, SurfaceShading, Teleport,
    ToolGrabs, ToolGrip, ToolOffset, ToolPose, ToolTouch, TouchBodies, TouchProbe, VisualState,
    WatchCommands, WatchPlugin, WatchView,
}

#[test]
fn no_name_of_the_prelude_is_also_one_of_bevys() {
    let text = include_str!("../crates/pliant/src/lib.rs");
    let text = text.split("pub mod prelude {").nth(1).unwrap().split("\n}").next().unwrap();
    let code = text.lines().filter(|line| !line.trim().starts_with('#'));
    let words = code.flat_map(|line| line.split(|c: char| !c.is_alphanumeric()));
    let mut names: Vec<&str> = words.filter(|word| word.starts_with(char::is_uppercase)).collect();
    names.sort_unstable();
    assert_eq!(names, NAMES, "import each name of the prelude above, in order");
}
