//! What a thousand linear bodies take from a frame without a picture, through the systems of the
//! plugin: of 20 modes resting, in motion, and in motion with a hand each, and of 60 modes with a
//! hand each. The frame of an app without bodies is subtracted.
//!
//! `cargo bench -p pliant_body --features bake,bevy/multi_threaded --bench many`. With the name of
//! a case, only that one runs, which is what a profiler wants.
#![allow(clippy::unwrap_used, missing_docs, reason = "a bench may stop")]

use std::{sync::Arc, time::Instant};

use bevy::{math::DVec3, prelude::*, time::TimeUpdateStrategy, transform::TransformPlugin};
use pliant_bake::{Anchor, BakeConfig, Comparison, bake};
use pliant_body::{
    BodyState, Grab, GrabOf, ModalAsset, ModalBody, PliantBodyPlugin, PliantSystems, RidingPlugin,
};
use pliant_modal::{Elasticity, ModalModel};

/// A step, and one frame of the app, s.
const STEP: f64 = 1.0 / 60.0;
const FRAMES: usize = 300;

struct Case {
    name: &'static str,
    bodies: usize,
    awake: bool,
    held: bool,
    /// Modes of a body, all of its model's.
    modes: usize,
}

const CASES: [Case; 6] = [
    Case { name: "none", bodies: 0, awake: false, held: false, modes: 20 },
    Case { name: "resting", bodies: 1000, awake: false, held: false, modes: 20 },
    Case { name: "awake", bodies: 1000, awake: true, held: false, modes: 20 },
    Case { name: "held", bodies: 1000, awake: true, held: true, modes: 20 },
    Case { name: "awake, 60 modes", bodies: 1000, awake: true, held: false, modes: 60 },
    Case { name: "held, 60 modes", bodies: 1000, awake: true, held: true, modes: 60 },
];

/// A shipped body of 20 modes, or a bar of 60.
fn model(modes: usize) -> ModalModel {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/bud.modal");
    let model = if modes == 20 {
        ModalModel::read(path).unwrap()
    } else {
        let mesh = pliant_mesh::shapes::bar([8, 2, 2], [0.2, 0.05, 0.05]).unwrap();
        let anchor = Anchor { axis: 0, comparison: Comparison::Less, bound: 1e-9 };
        let config = BakeConfig { modes, anchors: vec![anchor], ..BakeConfig::linear() };
        bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model
    };
    assert_eq!(model.mode_count(), modes);
    model
}

/// Moves the hands in circles of a centimeter.
fn lead(time: Res<Time>, mut grabs: Query<(&mut Grab, &Start)>) {
    let (sin, cos) = (6.0 * time.elapsed_secs_f64()).sin_cos();
    for (mut grab, start) in &mut grabs {
        grab.target = start.0 + 0.01 * DVec3::new(sin, 1.0 - cos, 0.0);
    }
}

#[derive(Component)]
struct Start(DVec3);

fn app(case: &Case) -> App {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin))
        .insert_resource(Time::<Fixed>::from_seconds(STEP))
        .insert_resource(TimeUpdateStrategy::FixedTimesteps(1))
        .add_plugins((PliantBodyPlugin::default(), RidingPlugin::default()))
        .add_systems(FixedUpdate, lead.before(PliantSystems::Input));
    let model = Arc::new(model(case.modes));
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(model.clone()));
    for index in 0..case.bodies {
        let mut body = ModalBody::new(handle.clone());
        body.settings.elasticity = Elasticity::Linear;
        if case.awake {
            body.settings.gravity = [0.0, -9.81, 0.0];
            body.rest_speed = 0.0;
        }
        let at = DVec3::new((index % 32) as f64, 0.0, (index / 32) as f64);
        let body = app.world_mut().spawn((body, Transform::from_translation(at.as_vec3()))).id();
        if case.held {
            let vertex = 20;
            let start = at + DVec3::from(model.surface().positions()[vertex].map(f64::from));
            app.world_mut().spawn((Grab::new(vertex as u32, 0.02, start), Start(start), GrabOf(body)));
        }
    }
    // The bodies are built, find their own shapes of held patches, and come to rest if they may.
    for _ in 0..120 {
        app.update();
    }
    let states: Vec<_> = app.world_mut().query::<&BodyState>().iter(app.world()).collect();
    assert_eq!(states.len(), case.bodies);
    assert!(states.iter().all(|state| state.is_resting() != case.awake), "{}", case.name);
    app
}

fn main() {
    let only = std::env::args().nth(1).filter(|name| !name.starts_with('-'));
    println!("| bodies | a frame, ms (99 %) | a body, us |\n| --- | --- | --- |");
    let mut empty = 0.0;
    for case in CASES.iter().filter(|case| only.as_ref().is_none_or(|name| *name == case.name)) {
        let mut app = app(case);
        let mut times: Vec<f64> = (0..FRAMES)
            .map(|_| {
                let start = Instant::now();
                app.update();
                start.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        times.sort_by(f64::total_cmp);
        let (median, p99) = (times[FRAMES / 2], times[FRAMES * 99 / 100]);
        if case.bodies == 0 {
            empty = median;
        }
        let each = 1e3 * (median - empty) / case.bodies.max(1) as f64;
        println!("| {} ({}) | {median:.3} ({p99:.3}) | {each:.3} |", case.name, case.bodies);
    }
}
