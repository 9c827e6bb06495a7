//! Dragging a body with the virtual device. The tests check the guarantees of the table
//! (`--example drag_table`) for some of its cells.

use crate::rig;

use std::sync::Arc;

use pliant_haptics::{Coupling, CouplingConfig, HandModel, LoopEvent, VirtualConfig};
use rig::{
    baked,
    scene::{Drag, Scene, SceneConfig, Subject, drag},
};

fn holds(config: SceneConfig) -> Drag {
    let what = format!(
        "E {:.0e} Pa, simulation {} Hz, round trip {} s, {}",
        config.young, config.simulation, config.round_trip, config.device.name
    );
    let d = drag(config);
    println!(
        "{what}: {:.1} mm/s, {:.2} mJ, {:.3} of {:.3} N",
        d.speeds[1] * 1e3,
        d.given * 1e3,
        d.step[0],
        d.step[1]
    );
    assert!(!d.oscillates(), "{what}: {:?} m/s", d.speeds);
    assert!(d.given <= 5e-3, "{what}: {} J beyond what was put in, with a tank of 5 mJ", d.given);
    assert!(d.step[0] <= d.step[1] * 1.000_001, "{what}: a step of {} N", d.step[0]);
    d
}

#[test]
fn what_counts_as_calm() {
    let of = |early: f64, late: f64| Drag { speeds: [early, late], given: 0.0, step: [0.0, 1.0], force: 0.0 };
    for (early, late) in [(0.0, 0.0), (0.9, 0.004), (0.005, 0.005), (0.02, 0.013), (0.9, 0.02)] {
        assert!(!of(early, late).oscillates(), "{early} then {late} m/s");
    }
    for (early, late) in
        [(0.9, 0.6), (0.9, 0.021), (0.006, 0.006), (0.02, 0.015), (0.0, 0.01), (0.9, f64::NAN)]
    {
        assert!(of(early, late).oscillates(), "{early} then {late} m/s");
        assert!(!of(early, late).keeps_its_promises());
    }
}

#[test]
fn dragging_near_is_calm() {
    for young in [1e3, 1e5, 1e11] {
        for simulation in [40.0, 240.0] {
            for hand in [HandModel::FIRM, HandModel::LOOSE, HandModel::NONE] {
                holds(SceneConfig { young, simulation, hand, modes: 12, ..SceneConfig::default() });
            }
        }
    }
}

/// The motors work on a hand that lowers a weight, and what they give is what lifting took. It is
/// no energy of the controller's own, so passivity must not cut the force.
#[test]
fn a_free_body_weighs_as_much_when_it_is_lowered() {
    const WEIGHT: f64 = 1.0;
    const WAY: f64 = 0.04;
    for modal in [false, true] {
        let subject = Subject::Baked(Arc::new(baked::jack()));
        let hand = HandModel::FIRM;
        let mut scene = Scene::new(SceneConfig {
            subject,
            hand,
            modes: 12,
            weight: WEIGHT,
            modal,
            ..SceneConfig::default()
        });
        scene.run(3.0);
        let (mut lowest, mut largest) = (f64::INFINITY, 0.0f64);
        for round in 0..5 {
            for (from, to) in [(0.0, WAY), (WAY, 0.0)] {
                let mut sum = 0.0;
                for k in 1..=2000 {
                    let s = f64::from(k) / 2000.0;
                    scene.hand.set_target([0.0, from + (to - from) * s * s * (3.0 - 2.0 * s), 0.0]);
                    scene.tick();
                    sum -= scene.cycle.core().last().wrench.force[1];
                }
                let mean = sum / 2000.0;
                (lowest, largest) = (lowest.min(mean), largest.max(mean));
                // A hand that lifts and lowers slowly carries the weight, whichever way it moves.
                // The difference is the damper's.
                assert!((mean - WEIGHT).abs() < 0.15 * WEIGHT, "round {round}, to {to} m: {mean} N");
            }
        }
        println!(
            "modal {modal}: {lowest:.3} to {largest:.3} of {WEIGHT} N, given {:.2} mJ",
            1e3 * scene.most_given
        );
        assert!(scene.most_given <= 5e-3, "{} J beyond what was put in", scene.most_given);
        assert!(!scene.events.iter().any(|e| matches!(e, LoopEvent::Fault(_))), "{:?}", scene.events);
    }
}

#[test]
fn dragging_over_a_network_is_calm() {
    for modal in [false, true] {
        for young in [1e3, 1e5] {
            for hand in [HandModel::LIGHT, HandModel::NONE] {
                holds(SceneConfig {
                    young,
                    hand,
                    modal,
                    round_trip: 0.196,
                    modes: 12,
                    ..SceneConfig::default()
                });
            }
        }
    }
}

#[test]
fn without_friction_it_is_calm_too() {
    for modal in [false, true] {
        let device = VirtualConfig { name: "slippery Touch", friction: 0.0, ..VirtualConfig::touch() };
        holds(SceneConfig {
            young: 1e5,
            device,
            hand: HandModel::LOOSE,
            modal,
            modes: 12,
            ..SceneConfig::default()
        });
    }
}

#[test]
fn a_baked_body_is_calm_in_every_hand() {
    let pip = Subject::Baked(Arc::new(baked::pip()));
    for round_trip in [0.0, 0.196] {
        for (_, hand) in HandModel::PRESETS {
            for (young, simulation, modal) in [
                (1e3, 40.0, false),
                (1e3, 1000.0, true),
                (1e5, 120.0, true),
                (1e5, 240.0, false),
                (1e8, 40.0, true),
                (1e11, 40.0, false),
                (1e11, 1000.0, true),
            ] {
                let subject = pip.clone();
                holds(SceneConfig {
                    subject,
                    young,
                    hand,
                    simulation,
                    modal,
                    round_trip,
                    ..SceneConfig::default()
                });
            }
        }
    }
}

#[test]
fn another_size_and_stiffness_of_a_bake_scales_as_it_must() {
    // The compliance of a patch scales with size and material as 1 / (E L). Ten times the modulus
    // at half the size gives a fifth of the compliance.
    let pip = baked::pip();
    let patch = |m: &pliant_modal::ModalModel| {
        pliant_modal::Patch::around(m.surface(), baked::top(m), 0.05 * m.size()).unwrap()
    };
    let compliance = |m: &pliant_modal::ModalModel| {
        let modes: f64 = (0..m.mode_count())
            .map(|k| {
                let row: f64 =
                    patch(m).entries().iter().map(|&(v, w)| w * f64::from(m.displacement_row(v, 0, k))).sum();
                (row / m.omega()[k]).powi(2)
            })
            .sum();
        [modes, m.residual_flexibility(&patch(m), m.mode_count()).unwrap()[0][0]]
    };
    let other = baked::made_of(&pip, 10.0 * pip.info().young, 0.5 * pip.size());
    for (a, b) in compliance(&pip).into_iter().zip(compliance(&other)) {
        assert!((b / a * 5.0 - 1.0).abs() < 1e-4, "{b} for a fifth of {a} m/N");
    }
    assert!((other.mass() / pip.mass() * 8.0 - 1.0).abs() < 1e-9);
}

#[test]
fn the_hand_feels_the_body() {
    // Static force on the hand from the block's tip: body, coupling and arm are in series. With E =
    // 1e4 Pa the block has E A / L = 160 N/m, the arm 150 N/m, and the coupling what the clamp
    // leaves. The drag is 30 mm long.
    for modal in [false, true] {
        let d = holds(SceneConfig { young: 1e4, hand: HandModel::LIGHT, modal, ..SceneConfig::default() });
        let device = VirtualConfig { friction: 0.0, ..VirtualConfig::touch() };
        let free =
            drag(SceneConfig { young: 1e4, hand: HandModel::LIGHT, modal, device, ..SceneConfig::default() });
        let coupling = 0.7 * 400.0;
        let want = 0.03 / (1.0 / 160.0 + 1.0 / 150.0 + 1.0 / coupling);
        // The thermal budget limits a force above the permanent 0.88 N only after seconds.
        assert!((free.force / want - 1.0).abs() < 0.03, "{} N for {want} N", free.force);
        // Friction (0.26 N) holds a part of the force back.
        assert!((d.force - want).abs() < 0.26, "{} N for {want} N", d.force);
    }
}

#[test]
fn a_slow_loop_and_a_fast_one() {
    for rate in [500.0, 8000.0] {
        for modal in [false, true] {
            for (young, hand, simulation) in [
                (1e3, HandModel::LOOSE, 40.0),
                (1e5, HandModel::LIGHT, 120.0),
                (1e5, HandModel::NONE, 240.0),
                (1e11, HandModel::FIRM, 120.0),
            ] {
                holds(SceneConfig {
                    young,
                    hand,
                    simulation,
                    rate,
                    modal,
                    modes: 12,
                    ..SceneConfig::default()
                });
            }
            // The force equals that at 1000 Hz: body, arm and the coupling that this rate allows,
            // in series.
            let device = VirtualConfig { friction: 0.0, ..VirtualConfig::touch() };
            let coupling =
                Coupling::clamp(&CouplingConfig::default(), &device.info(), rate, 0.0, 0.0).stiffness;
            let hand = HandModel::LIGHT;
            let d = holds(SceneConfig { young: 1e4, hand, device, rate, modal, ..SceneConfig::default() });
            let want = 0.03 / (1.0 / 160.0 + 1.0 / 150.0 + 1.0 / coupling);
            assert!((d.force / want - 1.0).abs() < 0.03, "{rate} Hz: {} N for {want} N", d.force);
            // The slew limit is in newtons per second at any rate: full force in 5 ms.
            assert!((d.step[1] * rate * 5e-3 - 3.3).abs() < 1e-9, "{rate} Hz: {} N a period", d.step[1]);
        }
    }
}
