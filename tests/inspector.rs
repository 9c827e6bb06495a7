//! Tests that what users meet can be looked at and set in `bevy-inspector-egui`: each component and
//! resource, with all of its fields, and a body with a hand while it moves.

use bevy::{
    ecs::reflect::{AppTypeRegistry, ReflectComponent, ReflectResource},
    math::DVec3,
    prelude::*,
    reflect::prelude::ReflectDefault,
    transform::TransformPlugin,
};
use bevy_inspector_egui::{DefaultInspectorConfigPlugin, bevy_inspector, egui};
use pliant::{
    body::BakePlugin,
    modal::ModalModel,
    net::{HostConfig, NetPlugin},
    prelude::*,
};

/// What an inspector can only name, and why.
const OPAQUE: [(&str, &str); 3] = [
    (
        "VisualState",
        "what is shown, not a setting: the two poses between which it goes on are not made by hand",
    ),
    ("SurfacePart", "a part of a drawn mesh: Bevy's `Range` has no inspector"),
    ("SavedState", "the state of a solver, as it is saved"),
];

fn app() -> App {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin, DefaultInspectorConfigPlugin))
        .add_plugins((
            PliantPlugins::default(),
            HapticsPlugin::default(),
            NetPlugin::host(HostConfig::default()).unwrap(),
            BakePlugin { cache: None },
            WatchPlugin,
        ));
    app
}

/// Draws an inspector with all of its headers open, and returns its texts.
fn texts(draw: impl FnMut(&mut egui::Ui)) -> Vec<String> {
    fn collect(shape: &egui::Shape, texts: &mut Vec<String>) {
        match shape {
            egui::Shape::Vec(shapes) => shapes.iter().for_each(|shape| collect(shape, texts)),
            egui::Shape::Text(text) => texts.push(text.galley.job.text.clone()),
            _ => {}
        }
    }
    let context = egui::Context::default();
    context.memory_mut(|memory| memory.set_everything_is_visible(true));
    let room = egui::Rect::from_min_size(egui::Pos2::ZERO, egui::vec2(2000.0, 100_000.0));
    let input = egui::RawInput { screen_rect: Some(room), ..Default::default() };
    let mut found = Vec::new();
    let output = context.run_ui(input, draw);
    output.shapes.iter().for_each(|shape| collect(&shape.shape, &mut found));
    found
}

/// What the inspector says of a value that it cannot show.
fn complaints(texts: &[String]) -> Vec<&String> {
    let says = ["reflect(opaque)", "cannot be displayed", "not registered", "No access", "unconstructable"];
    texts.iter().filter(|text| says.iter().any(|says| text.contains(says))).collect()
}

#[test]
fn an_inspector_shows_every_field_of_our_components_and_resources() {
    let mut app = app();
    let registry = app.world().resource::<AppTypeRegistry>().clone();
    let ours: Vec<(&str, Box<dyn Reflect>)> = registry
        .read()
        .iter()
        .filter(|kind| kind.type_info().type_path().starts_with("pliant"))
        .filter(|kind| kind.contains::<ReflectComponent>() || kind.contains::<ReflectResource>())
        .filter_map(|kind| Some((kind.type_info().type_path(), kind.data::<ReflectDefault>()?.default())))
        .collect();
    assert!(ours.len() > 40, "{} types", ours.len());
    let (mut wrong, mut opaque) = (Vec::new(), Vec::new());
    for (path, mut value) in ours {
        let texts = texts(|ui| {
            bevy_inspector::ui_for_value(&mut *value, ui, app.world_mut());
        });
        let name = path.rsplit("::").next().unwrap();
        match OPAQUE.iter().find(|(opaque, _)| *opaque == name) {
            Some((name, _)) => opaque.extend((!complaints(&texts).is_empty()).then_some(*name)),
            None => wrong.extend(complaints(&texts).into_iter().map(|text| format!("{path}: {text}"))),
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert_eq!(opaque.len(), OPAQUE.len(), "these can be looked at by now: all but {opaque:?}");
}

#[test]
fn a_body_and_its_hand_are_shown_while_they_move_and_move_as_if_nobody_looked() {
    let model = || {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal");
        ModalAsset(ModalModel::read(path).unwrap().into())
    };
    let run = |looks: bool| {
        let mut app = app();
        app.insert_resource(bevy::time::TimeUpdateStrategy::FixedTimesteps(1));
        let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(model());
        let body = app.world_mut().spawn(ModalBody::new(handle)).id();
        let hand = app.world_mut().spawn((Grab::new(76, 0.02, DVec3::new(0.1, 0.3, 0.0)), GrabOf(body))).id();
        for _ in 0..30 {
            app.update();
            if !looks {
                continue;
            }
            let world = app.world_mut();
            let body_texts = texts(|ui| bevy_inspector::ui_for_entity(world, body, ui));
            let hand_texts = texts(|ui| bevy_inspector::ui_for_entity(world, hand, ui));
            for (texts, name) in
                [(&body_texts, "ModalBody"), (&body_texts, "stiffness"), (&hand_texts, "Grab")]
            {
                assert!(texts.iter().any(|text| text == name), "no {name} in {texts:?}");
            }
        }
        app.world().get::<BodyState>(body).unwrap().body().q().to_vec()
    };
    let (seen, unseen) = (run(true), run(false));
    assert!(unseen.iter().any(|q| q.abs() > 1e-6), "the hand moves the body");
    assert_eq!(seen, unseen);
}
