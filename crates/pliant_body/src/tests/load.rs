//! Tests of a thousand bodies of one model.

use bevy::{diagnostic::DiagnosticsStore, prelude::*};

use super::{app, model, steps};
use crate::{AWAKE_BODIES, BodyState, ModalAsset, ModalBody, STEP_TIME, VisualState};

const BODIES: usize = 1_000;

fn many_bodies(app: &mut App, bundle: impl Bundle + Clone) -> Vec<Entity> {
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model::bar()));
    let bodies = (0..BODIES)
        .map(|_| app.world_mut().spawn((ModalBody::new(handle.clone()), bundle.clone())).id())
        .collect();
    app.update();
    bodies
}

/// Returns the newest measurement and the number of measurements.
fn measured(app: &App, path: &bevy::diagnostic::DiagnosticPath) -> (Option<f64>, usize) {
    let found = app.world().resource::<DiagnosticsStore>().get(path).unwrap();
    (found.measurement().map(|newest| newest.value), found.history_len())
}

#[test]
fn a_thousand_bodies_at_rest_are_neither_stepped_nor_shown_anew_and_one_that_is_touched_wakes_alone() {
    let mut app = app();
    let bodies = many_bodies(&mut app, ());
    steps(&mut app, 1);
    assert_eq!(measured(&app, &AWAKE_BODIES).0, Some(1_000.0));
    steps(&mut app, 25);
    let states = |app: &mut App| {
        let mut query = app.world_mut().query::<(&BodyState, &VisualState)>();
        query
            .iter(app.world())
            .map(|(state, visual)| (state.body().state().clone(), visual.version()))
            .collect::<Vec<_>>()
    };
    let before = states(&mut app);
    assert_eq!(before.len(), BODIES);
    let timed = measured(&app, &STEP_TIME).1;
    steps(&mut app, 20);
    assert_eq!(measured(&app, &AWAKE_BODIES).0, Some(0.0));
    assert_eq!(measured(&app, &STEP_TIME).1, timed, "no step was timed, as there was none");
    assert!(states(&mut app) == before, "no state and no version moved");

    let one = bodies[417];
    let mut touched = app.world_mut().get_mut::<BodyState>(one).unwrap();
    touched.body_mut().apply_impulse(model::tip(), [0.0, 0.5, 0.0]).unwrap();
    steps(&mut app, 1);
    assert_eq!(measured(&app, &AWAKE_BODIES).0, Some(1.0));
    let moved = states(&mut app).iter().zip(&before).filter(|(now, before)| now != before).count();
    assert_eq!(moved, 1);
}

#[cfg(feature = "render")]
#[test]
fn a_thousand_bodies_at_rest_on_screen_write_no_mesh() {
    use bevy::{camera::visibility::ViewVisibility, mesh::MeshPlugin};

    let mut app = app();
    app.add_plugins(MeshPlugin);
    let bodies = many_bodies(&mut app, ());
    for body in bodies {
        app.world_mut().entity_mut(body).insert((ViewVisibility::VISIBLE, InheritedVisibility::VISIBLE));
    }
    steps(&mut app, 30);
    let mut cursor = app.world().resource::<Messages<AssetEvent<Mesh>>>().get_cursor_current();
    let mut written = 0;
    for _ in 0..5 {
        app.update();
        written += cursor.read(app.world().resource::<Messages<AssetEvent<Mesh>>>()).count();
    }
    assert_eq!(written, 0);
    assert!(measured(&app, &crate::DEFORM_TIME).0.is_some(), "they were drawn when they came");
}
