//! Tests what `pliant drop` measures.

use std::sync::Arc;

use pliant_lab::{
    LabError,
    drop::{Drop, Onto, drop},
    pile::{Pile, pile},
};
use pliant_modal::ModalModel;

fn jack() -> Arc<ModalModel> {
    Arc::new(ModalModel::read("../../assets/jack.modal").unwrap())
}

#[test]
fn a_body_falls_freely_until_it_touches_and_then_lies() {
    let model = jack();
    let dropped = drop(&model, &Drop { seconds: 8.0, ..Drop::default() }).unwrap();
    let (first, last) = (dropped.ticks[0], dropped.ticks[dropped.ticks.len() - 1]);
    assert_eq!((dropped.ticks.len(), last.time), (481, 8.0));
    let total = |tick: &pliant_lab::drop::DropTick| tick.kinetic + tick.elastic + tick.potential;
    for tick in &dropped.ticks {
        assert!(total(tick) <= total(&first) + 1e-9, "{} s: {} J", tick.time, total(tick));
        if tick.time < (2.0 * 0.1 / 9.81f64).sqrt() - 0.02 {
            let fallen = 0.5 * 9.81 * tick.time * tick.time;
            assert!((first.center[1] - fallen - tick.center[1]).abs() < 1e-12 && tick.contacts == 0);
        }
    }
    let weight = dropped.mass * 9.81;
    println!("after 8 s: {last:?}");
    assert!((last.contact_force[1] / weight - 1.0).abs() < 1e-2, "{last:?}");
    assert!(last.penetration < 2e-3 * dropped.size && last.kinetic < 1e-3 * total(&first));
}

#[test]
fn the_tilted_ground_is_the_level_one_seen_from_aside() {
    let model = jack();
    let fall = Drop { tilt: 20.0, gravity: 0.0, seconds: 0.1, ..Drop::default() };
    let still = drop(&model, &fall).unwrap();
    // Without gravity it stays above the ground by the gap, measured along the normal.
    let (sin, cos) = 20f64.to_radians().sin_cos();
    let level = drop(&model, &Drop { tilt: 0.0, ..fall }).unwrap();
    let ([x, y, _], [a, b, _]) = (level.ticks[0].center, still.ticks[6].center);
    assert!((cos * x - sin * y - a).abs() < 1e-12 && (sin * x + cos * y - b).abs() < 1e-12);
    let ball = drop(&model, &Drop { onto: Onto::Sphere(0.2), height: 0.0, ..Drop::default() }).unwrap();
    assert!(ball.ticks.iter().any(|tick| tick.contacts > 0));
}

#[test]
fn what_cannot_fall_is_refused() {
    let pip = Arc::new(ModalModel::read("../../assets/pip.modal").unwrap());
    assert!(matches!(drop(&pip, &Drop::default()), Err(LabError::Anchored)));
    let model = jack();
    for bad in [
        Drop { height: -0.1, ..Drop::default() },
        Drop { tilt: f64::NAN, ..Drop::default() },
        Drop { gravity: f64::INFINITY, ..Drop::default() },
        Drop { seconds: 0.0, ..Drop::default() },
        Drop { rate: 0.0, ..Drop::default() },
        Drop { onto: Onto::Sphere(0.0), ..Drop::default() },
    ] {
        assert!(matches!(drop(&model, &bad), Err(LabError::Model(_))), "{bad:?}");
    }
    let bad = Drop { friction: -1.0, ..Drop::default() };
    assert!(matches!(drop(&model, &bad), Err(LabError::Step(_))));
}

#[test]
fn a_body_falls_onto_another_and_energy_never_rises() {
    let pip = Arc::new(ModalModel::read("../../assets/pip.modal").unwrap());
    for base in [pip, jack()] {
        let fall = Drop { onto: Onto::Body(base), seconds: 1.0, height: 0.05, ..Drop::default() };
        let dropped = drop(&jack(), &fall).unwrap();
        let total = |tick: &pliant_lab::drop::DropTick| tick.kinetic + tick.elastic + tick.potential;
        let first = total(&dropped.ticks[0]);
        assert!(dropped.ticks.iter().all(|tick| total(tick) <= first + 1e-9));
        // It begins above the other and touches it first.
        let touch = dropped.ticks.iter().position(|tick| tick.contacts > 0).unwrap();
        let time = (2.0 * 0.05 / 9.81f64).sqrt();
        assert!((dropped.ticks[touch].time - time).abs() < 0.1, "{} s", dropped.ticks[touch].time);
    }
}

#[test]
fn a_pile_comes_to_rest_without_gaining_energy() {
    let piled = pile(&jack(), &Pile { count: 4, seconds: 4.0, ..Pile::default() }).unwrap();
    println!("{piled:?}");
    assert!(piled.contacts > 8 && piled.failures == 0);
    assert!(piled.gain < 1e-9 && piled.kinetic_at_end < 1e-2 * piled.start, "{piled:?}");
    assert!(pile(&jack(), &Pile { count: 0, ..Pile::default() }).is_err());
}
