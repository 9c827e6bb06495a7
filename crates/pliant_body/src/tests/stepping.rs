use bevy::{asset::LoadState, math::DVec3, prelude::*};

use super::{app, frames_of, model, refusals, spawn, spawn_with, state, steps, tick};
use crate::{
    BodyStepTimes, Driven, Grab, GrabOf, ModalAsset, ModalBody, PliantBodyPlugin, PliantSystems, Pose,
    VisualState,
};

#[test]
fn a_body_under_its_own_weight_hangs_by_participation_over_stiffness() {
    let mut app = app();
    // The expected value belongs to the body without warping.
    let falls =
        |body: &mut ModalBody| (body.settings.warp, body.settings.gravity) = (false, [0.0, -9.81, 0.0]);
    let body = spawn_with(&mut app, model::bar(), falls, ());
    steps(&mut app, 400);
    // For one mode of bending along y, phi = sqrt(5/m) x^2 and q = g Gamma / omega^2, so the tip
    // sinks by phi(1) q = 5/3 g / omega^2.
    let expected = 5.0 / 3.0 * 9.81 / (2.0 * std::f64::consts::PI * model::FREQUENCIES[0]).powi(2);
    let tip = (5.0 / model::MASS).sqrt() * state(&app, body).body().q()[0];
    assert!((tip + expected).abs() < 1e-4 * expected, "sank {tip} m, expected -{expected} m");
}

#[test]
fn the_shape_is_the_same_to_the_bit_whatever_the_order_of_spawning() {
    // Three bodies are spawned in one frame, each with two hands. Two of them share a model. The
    // states are returned in the same order for every order of spawning.
    let run = |order: [usize; 3]| {
        let mut app = app();
        let mut models = app.world_mut().resource_mut::<Assets<ModalAsset>>();
        let bar = models.add(ModalAsset::from(model::bar()));
        let free = models.add(ModalAsset::from(model::free_bar()));
        let mut bodies = [Entity::PLACEHOLDER; 3];
        for which in order {
            let mut body = ModalBody::new(if which == 2 { free.clone() } else { bar.clone() });
            body.settings.gravity = [0.3, [-9.81, -1.62, -3.0][which], 0.1];
            bodies[which] = app.world_mut().spawn(body).id();
            for pull in [0.1, -0.2] {
                let grab = Grab::new(model::tip(), 0.1, DVec3::new(1.0, pull * which as f64, 0.03));
                app.world_mut().spawn((grab, GrabOf(bodies[which])));
            }
        }
        steps(&mut app, 60);
        bodies.map(|body| state(&app, body).body().state().clone())
    };
    let first = run([0, 1, 2]);
    assert!(first[0] != first[1] && first[0].q[0] != 0.0 && first[2].q[0] != 0.0);
    for order in [[1, 0, 2], [2, 1, 0], [2, 0, 1]] {
        assert!(run(order) == first, "{order:?}");
    }
}

#[test]
fn a_body_that_is_despawned_in_the_frame_in_which_it_is_made_is_no_accident() {
    let mut app = app();
    let refused = spawn_with(&mut app, model::bar(), |body| body.settings.damping_scale = f64::NAN, ());
    app.world_mut().get_mut::<ModalBody>(refused).unwrap().settings.damping_scale = -1.0;
    let model = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model::bar()));
    let made = app.world_mut().spawn(ModalBody::new(model)).id();
    let kill = move |mut commands: Commands, bodies: Query<Entity, With<ModalBody>>| {
        bodies.iter().for_each(|body| commands.entity(body).try_despawn());
    };
    // The commands of `kill` are applied at the same point as those of the plugin, and before them.
    app.add_systems(PostUpdate, kill.before_ignore_deferred(crate::step::build_bodies));
    steps(&mut app, 2);
    assert!([refused, made].iter().all(|body| app.world().get_entity(*body).is_err()));
}

#[test]
fn a_body_whose_component_is_taken_away_keeps_nothing_and_may_have_it_again() {
    let mut app = app();
    let body = spawn_with(&mut app, model::bar(), |body| body.settings.gravity = [0.0, -1.0, 0.0], ());
    steps(&mut app, 5);
    let settings = app.world_mut().entity_mut(body).take::<ModalBody>().unwrap();
    steps(&mut app, 2);
    assert!(app.world().get::<crate::BodyState>(body).is_none());
    assert!(app.world().get::<VisualState>(body).is_none());
    app.world_mut().entity_mut(body).insert(settings);
    steps(&mut app, 3);
    assert!(state(&app, body).body().q()[0] < 0.0);
}

#[test]
fn pausing_virtual_time_stops_the_tick_and_the_state() {
    let mut app = app();
    let body = spawn_with(&mut app, model::bar(), |body| body.settings.gravity = [0.0, -1.0, 0.0], ());
    frames_of(&mut app, 1.0);
    steps(&mut app, 5);
    app.world_mut().resource_mut::<Time<Virtual>>().pause();
    let (before, at) = (state(&app, body).body().q().to_vec(), tick(&app));
    steps(&mut app, 10);
    assert_eq!((state(&app, body).body().q(), tick(&app)), (&before[..], at));
    app.world_mut().resource_mut::<Time<Virtual>>().unpause();
    steps(&mut app, 2);
    assert_eq!(tick(&app), at + 2);
    assert_ne!(state(&app, body).body().q(), before);
}

#[test]
fn a_still_body_rests_after_half_a_second_and_a_touch_wakes_it() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    steps(&mut app, 19);
    assert!(!state(&app, body).is_resting());
    steps(&mut app, 2);
    assert!(state(&app, body).is_resting(), "0.5 s are 20 steps");
    let version = app.world().get::<VisualState>(body).unwrap().version();
    steps(&mut app, 50);
    // There was no step, and the picture did not change.
    assert_eq!(app.world().get::<VisualState>(body).unwrap().version(), version);

    app.world_mut()
        .get_mut::<crate::BodyState>(body)
        .unwrap()
        .body_mut()
        .apply_impulse(model::tip(), [0.0, 1.0, 0.0])
        .unwrap();
    steps(&mut app, 1);
    assert!(state(&app, body).body().q()[0] > 0.0);
    assert!(app.world().get::<VisualState>(body).unwrap().version() > version);
}

#[test]
fn a_body_that_creeps_back_does_not_rest_while_it_is_bent() {
    let mut app = app();
    // The body returns within some 40 s, always slower than its rest speed.
    let relaxation = pliant_modal::Relaxation { ratio: 0.5, time: 20.0 };
    let slow = |body: &mut ModalBody| (body.settings.relaxation, body.rest_speed) = (Some(relaxation), 0.01);
    let body = spawn_with(&mut app, model::bar(), slow, ());
    // The state is that of a body that was held aside for long and then released.
    let mut entity = app.world_mut().get_mut::<crate::BodyState>(body).unwrap();
    let mut bent = entity.body().state().clone();
    (bent.q[0], bent.z[0]) = (0.05, 0.1);
    entity.body_mut().set_state(&bent).unwrap();
    let mass = state(&app, body).model().mass();
    for _ in 0..40 * 200 {
        app.update();
        let state = state(&app, body);
        if state.is_resting() {
            break;
        }
    }
    let state = state(&app, body);
    let bent = (state.body().q()[0].powi(2) / mass).sqrt();
    assert!(state.is_resting() && bent < 0.01 * 0.5, "it rests bent by {bent} m");
}

#[test]
fn the_picture_stands_between_the_last_two_steps() {
    let mut app = app();
    let body = spawn_with(&mut app, model::bar(), |body| body.settings.gravity = [0.0, -1.0, 0.0], ());
    steps(&mut app, 3);
    frames_of(&mut app, 0.25);
    let mut seen = Vec::new();
    for _ in 0..8 {
        app.update();
        let visual = app.world().get::<VisualState>(body).unwrap();
        let fraction = app.world().resource::<Time<Fixed>>().overstep_fraction_f64();
        let expected = visual.previous()[0] + (visual.current()[0] - visual.previous()[0]) * fraction;
        assert_eq!(visual.q()[0], expected, "at {fraction} of a step");
        assert_eq!(visual.current(), state(&app, body).body().q());
        seen.push(visual.q()[0]);
    }
    assert!(seen.windows(2).all(|w| w[1] < w[0]), "it falls in every frame: {seen:?}");
}

#[test]
fn a_remote_body_shows_what_is_pushed_and_is_not_stepped() {
    let mut app = app();
    let body =
        spawn_with(&mut app, model::bar(), |body| body.settings.gravity = [0.0, -1.0, 0.0], Driven::Remote);
    steps(&mut app, 10);
    assert_eq!(state(&app, body).body().q(), [0.0; 4]);

    app.add_systems(
        FixedUpdate,
        (|mut visual: Single<&mut VisualState>, tick: Res<crate::PliantTick>| {
            visual.push(&[tick.0 as f64, 0.0, 0.0, 0.0]).unwrap();
        })
        .in_set(PliantSystems::Publish),
    );
    frames_of(&mut app, 0.5);
    steps(&mut app, 9);
    let visual = app.world().get::<VisualState>(body).unwrap();
    let fraction = app.world().resource::<Time<Fixed>>().overstep_fraction_f64();
    assert_eq!(visual.q()[0], (tick(&app) - 1) as f64 + fraction);

    let mut visual = app.world_mut().get_mut::<VisualState>(body).unwrap();
    assert!(visual.push(&[0.0; 3]).unwrap_err().to_string().contains("needs 4 modal coordinates, got 3"));
    assert!(visual.push(&[0.0, f64::NAN, 0.0, 0.0]).unwrap_err().to_string().contains("modal coordinate 1"));
    assert!(visual.push_at(&[0.0; 4], Pose { origin: DVec3::NAN, orientation: Default::default() }).is_err());
    assert!(visual.current()[0] > 0.0, "what was refused changed nothing");
}

#[test]
fn in_another_schedule_the_step_is_the_frame() {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin))
        .insert_resource(bevy::time::TimeUpdateStrategy::ManualDuration(std::time::Duration::from_millis(5)))
        .add_plugins(PliantBodyPlugin::new(Update));
    app.update();
    let body = spawn_with(&mut app, model::bar(), |body| body.settings.gravity = [0.0, -1.0, 0.0], ());
    steps(&mut app, 9);
    assert_eq!(tick(&app), 10, "the first update of an app has no time in it");
    assert_eq!(state(&app, body).body().config().step, 0.005);
    let visual = app.world().get::<VisualState>(body).unwrap();
    assert_eq!(visual.q(), state(&app, body).body().q());
}

#[test]
fn settings_that_make_no_body_are_refused_by_name_and_may_be_mended() {
    let mut app = app();
    let body =
        spawn_with(&mut app, model::bar(), |body| body.settings.damping_scale = f64::NAN, Name::new("jelly"));
    steps(&mut app, 3);
    assert!(app.world().get::<crate::BodyState>(body).is_none());
    let refused = refusals(&mut app);
    assert_eq!(refused.len(), 1, "once, not every frame: {refused:?}");
    assert!(refused[0].0 == body && refused[0].1.contains("damping_scale"), "{refused:?}");

    app.world_mut().get_mut::<ModalBody>(body).unwrap().settings.damping_scale = 1.0;
    steps(&mut app, 1);
    assert!(app.world().get::<crate::BodyState>(body).is_some());
    // An invalid change leaves the running body as it was.
    app.world_mut().get_mut::<ModalBody>(body).unwrap().settings.damping_scale = -1.0;
    steps(&mut app, 1);
    assert_eq!(state(&app, body).body().config().settings.damping_scale, 1.0);
    assert_eq!(refusals(&mut app).len(), 1);
}

#[test]
fn a_transform_that_cannot_place_a_body_is_refused_and_the_body_stays() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), Transform::from_xyz(1.0, 2.0, 3.0));
    steps(&mut app, 1);
    assert_eq!(state(&app, body).body().frame().origin(), [1.0, 2.0, 3.0]);
    let wrong = [
        Transform::from_scale(Vec3::new(1.0, 2.0, 1.0)),
        Transform::from_scale(Vec3::ZERO),
        Transform::from_scale(Vec3::new(-1.0, 1.0, 1.0)),
        Transform::from_xyz(f32::NAN, 0.0, 0.0),
        Transform::from_xyz(0.0, f32::INFINITY, 0.0),
        Transform::from_scale(Vec3::splat(f32::INFINITY)),
    ];
    for transform in wrong {
        app.world_mut().entity_mut(body).insert(transform);
        steps(&mut app, 3);
        let refused = refusals(&mut app);
        assert!(
            refused.len() == 1 && refused[0].1.contains("positive, uniform scale"),
            "{transform:?}: {refused:?}"
        );
        assert_eq!(state(&app, body).body().frame().origin(), [1.0, 2.0, 3.0]);
    }
}

#[test]
fn a_free_body_falls_by_its_own_transform_and_can_be_put_elsewhere() {
    let mut app = app();
    let start = Transform::from_xyz(0.0, 10.0, 0.0);
    let body =
        spawn_with(&mut app, model::free_bar(), |body| body.settings.gravity = [0.0, -10.0, 0.0], start);
    steps(&mut app, 40);
    // The time is one second minus one step: every update is a whole step, so the picture is one
    // step behind. s = g t^2 / 2.
    let t = 39.0 * super::STEP;
    let y = app.world().get::<Transform>(body).unwrap().translation.y;
    assert!((f64::from(y) - (10.0 - 5.0 * t * t)).abs() < 1e-4, "{y}");
    assert!((state(&app, body).body().frame().velocity()[1] + 10.0).abs() < 1e-9);

    app.world_mut().get_mut::<Transform>(body).unwrap().translation = Vec3::new(5.0, 100.0, 0.0);
    steps(&mut app, 2);
    let frame = state(&app, body).body().frame();
    assert!((frame.origin()[0] - 5.0).abs() < 1e-6 && frame.origin()[1] > 99.0, "{frame:?}");
    assert!(frame.velocity()[1] < -10.0, "its velocity is kept");
}

#[test]
fn a_free_body_that_is_put_elsewhere_is_seen_there_and_nowhere_between() {
    let mut app = app();
    let body = spawn_with(&mut app, model::free_bar(), |body| body.settings.gravity = [0.0, -1.0, 0.0], ());
    steps(&mut app, 3);
    frames_of(&mut app, 0.2);
    steps(&mut app, 8);
    let to = Transform::from_xyz(5.0, 100.0, -3.0).with_rotation(Quat::from_rotation_x(2.0));
    *app.world_mut().get_mut::<Transform>(body).unwrap() = to;
    for frame in 0..12 {
        app.update();
        let seen = app.world().get::<Transform>(body).unwrap();
        // The body continues to fall with its velocity, for less than 0.3 s at 1 m/s^2.
        let off = seen.translation.distance(to.translation);
        assert!(off < 0.1, "frame {frame}: {} instead of {}", seen.translation, to.translation);
        assert!(seen.rotation.angle_between(to.rotation) < 1e-3, "frame {frame}: {}", seen.rotation);
    }
    assert_ne!(app.world().get::<Transform>(body).unwrap().translation, to.translation, "it goes on");
}

#[test]
fn a_modal_file_loads_and_one_that_is_cut_altered_or_of_another_version_says_why() {
    let folder = std::env::temp_dir().join(format!("pliant_body_test_{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let bytes = model::bar().to_bytes();
    std::fs::write(folder.join("bar.modal"), &bytes).unwrap();
    let altered = |at: usize, by: u8| {
        let mut altered = bytes.clone();
        altered[at] = altered[at].wrapping_add(by);
        altered
    };
    // Each case is a defective file and the expected text of its error. The version is a number at
    // byte 8.
    let wrong = [
        ("cut", bytes[..bytes.len() / 2].to_vec(), "cut or padded .modal file"),
        ("altered", altered(bytes.len() - 9, 1), "altered"),
        ("newer", altered(8, 7), "version"),
        ("empty", Vec::new(), "expected it to begin with"),
        (
            "other",
            b"solid not a model at all, but long enough to have a header of its own".repeat(4),
            "not a .modal file",
        ),
    ];
    for (name, bytes, _) in &wrong {
        std::fs::write(folder.join(format!("{name}.modal")), bytes).unwrap();
    }

    let mut app = App::new();
    let assets = AssetPlugin { file_path: folder.display().to_string(), ..Default::default() };
    app.add_plugins((MinimalPlugins, assets, TransformPlugin, PliantBodyPlugin::default()));
    let server = app.world().resource::<AssetServer>().clone();
    let body = app.world_mut().spawn(ModalBody::new(server.load("bar.modal"))).id();
    let refused: Vec<Handle<ModalAsset>> =
        wrong.iter().map(|(name, ..)| server.load(format!("{name}.modal"))).collect();
    for handle in &refused {
        app.world_mut().spawn(ModalBody::new(handle.clone()));
    }
    let deadline = std::time::Instant::now() + std::time::Duration::from_secs(120);
    while app.world().get::<crate::BodyState>(body).is_none()
        || !refused.iter().all(|handle| server.load_state(handle).is_failed())
    {
        assert!(std::time::Instant::now() < deadline, "not loaded in 120 s");
        app.update();
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    assert_eq!(state(&app, body).model().hash(), model::bar().hash());
    for ((name, _, word), handle) in wrong.iter().zip(&refused) {
        let LoadState::Failed(error) = server.load_state(handle) else { panic!("{name} was loaded") };
        assert!(error.to_string().contains(word), "{name}: {error}");
    }
    assert_eq!(
        app.world_mut().query::<&crate::BodyState>().iter(app.world()).count(),
        1,
        "the others are no bodies"
    );
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn the_step_of_each_body_is_timed_where_somebody_asks() {
    let mut app = app();
    let moving = spawn_with(&mut app, model::bar(), |body| body.rest_speed = 0.0, ());
    let resting = spawn(&mut app, model::bar(), ());
    steps(&mut app, 30);
    assert!(app.world().get_resource::<BodyStepTimes>().is_none(), "nobody has asked");
    app.init_resource::<BodyStepTimes>();
    steps(&mut app, 2);
    assert_eq!(app.world().resource::<BodyStepTimes>().get(moving), None, "nobody has asked");
    app.world_mut().resource_mut::<BodyStepTimes>().ask();
    for _ in 0..BodyStepTimes::TICKS {
        steps(&mut app, 1);
        let times = app.world().resource::<BodyStepTimes>();
        let took = times.get(moving).unwrap();
        assert!(!took.is_zero() && took.as_secs() < 60, "{took:?}");
        assert_eq!(times.get(resting), None, "it was not stepped");
    }
    steps(&mut app, 1);
    assert_eq!(app.world().resource::<BodyStepTimes>().get(moving), None, "nobody asks any more");
}

#[test]
fn a_reflecting_tool_finds_every_component_and_reads_how_a_body_stands() {
    use std::any::TypeId;

    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    steps(&mut app, 30);
    let registry = app.world().resource::<AppTypeRegistry>().clone();
    let registry = registry.read();
    let components = [
        TypeId::of::<ModalBody>(),
        TypeId::of::<crate::BodyState>(),
        TypeId::of::<VisualState>(),
        TypeId::of::<Driven>(),
        TypeId::of::<crate::Grab>(),
        TypeId::of::<crate::GrabOf>(),
        TypeId::of::<crate::Grabs>(),
        TypeId::of::<crate::GrabForce>(),
        TypeId::of::<crate::NoPointerGrab>(),
    ];
    for id in components {
        assert!(registry.get_type_data::<ReflectComponent>(id).is_some(), "{id:?}");
    }
    let messages = [
        TypeId::of::<crate::BodyRefused>(),
        TypeId::of::<crate::SingleSteps>(),
        TypeId::of::<crate::Impulse>(),
        TypeId::of::<crate::Push>(),
    ];
    for id in messages {
        assert!(registry.get(id).is_some(), "{id:?}");
    }
    let reflected = registry.get_type_data::<ReflectComponent>(TypeId::of::<crate::BodyState>()).unwrap();
    let state = reflected.reflect(app.world().entity(body)).unwrap().reflect_ref().as_struct().unwrap();
    let resting = state.field("resting").and_then(|resting| resting.try_downcast_ref::<bool>());
    assert_eq!(resting, Some(&true));
}
