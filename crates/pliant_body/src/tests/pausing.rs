use bevy::{math::DVec3, prelude::*};

use super::{app, frames_of, model, spawn, spawn_with, state, steps, tick};
use crate::{Grab, GrabForce, GrabOf, SingleSteps, VisualState};

fn pause(app: &mut App) {
    app.world_mut().resource_mut::<Time<Virtual>>().pause();
}

fn version(app: &App, body: Entity) -> u64 {
    app.world().get::<VisualState>(body).unwrap().version()
}

#[test]
fn a_pause_steps_nothing_shows_nothing_new_and_acts_on_no_hand() {
    let mut app = app();
    let body = spawn_with(&mut app, model::bar(), |body| body.settings.gravity = [0.0, -1.0, 0.0], ());
    let hand = app.world_mut().spawn((Grab::new(model::tip(), 0.05, DVec3::X), GrabOf(body))).id();
    // The frames end between two steps, so the picture also stands between two steps during a
    // pause.
    frames_of(&mut app, 0.4);
    steps(&mut app, 12);
    pause(&mut app);
    steps(&mut app, 1);
    let seen = |app: &App| {
        let force = *app.world().get::<GrabForce>(hand).unwrap();
        (tick(app), version(app, body), state(app, body).body().q().to_vec(), force)
    };
    let before = seen(&app);
    app.world_mut().get_mut::<Grab>(hand).unwrap().target.y = 0.3;
    steps(&mut app, 20);
    assert_eq!(seen(&app), before);
    app.world_mut().write_message(SingleSteps(1));
    steps(&mut app, 1);
    assert!(seen(&app).3.force.length() > before.3.force.length(), "the hand that was moved meanwhile pulls");
}

#[test]
fn single_steps_are_as_many_as_were_asked_for_and_like_any_others() {
    let run = |by_hand: bool| {
        let mut app = app();
        let body = spawn_with(&mut app, model::bar(), |body| body.settings.gravity = [0.0, -1.0, 0.0], ());
        if by_hand {
            pause(&mut app);
            for asked in [1, 3, 0, 4] {
                let before = tick(&app);
                app.world_mut().write_message(SingleSteps(asked));
                steps(&mut app, 1);
                assert_eq!(tick(&app) - before, u64::from(asked));
                steps(&mut app, 5);
                assert_eq!(tick(&app) - before, u64::from(asked), "asked once, made once");
            }
        } else {
            steps(&mut app, 8);
        }
        state(&app, body).body().q().to_vec()
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn single_steps_have_a_limit_and_add_nothing_to_time_that_runs() {
    let mut app = app();
    spawn(&mut app, model::bar(), ());
    let before = tick(&app);
    app.world_mut().write_message(SingleSteps(5));
    steps(&mut app, 1);
    assert_eq!(tick(&app) - before, 1, "the frame's own step");
    pause(&mut app);
    let before = tick(&app);
    app.world_mut().write_message(SingleSteps(u32::MAX));
    app.world_mut().write_message(SingleSteps(u32::MAX));
    steps(&mut app, 1);
    assert_eq!(tick(&app) - before, u64::from(SingleSteps::MAX));
}
