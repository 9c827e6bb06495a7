//! A tool's ball that touches in the loop, with a virtual device in virtual time.

use crate::rig;

use std::sync::Arc;

use pliant_haptics::{HandModel, MAX_PLANES, VirtualConfig};
use pliant_modal::ProbeConfig;
use rig::{
    valley::{VALLEY, valley},
    world::{DOWN, RADIUS, UP, World, norm, slew},
};

#[test]
fn on_a_rigid_floor_the_hand_feels_the_coupling_spring() {
    for simulation in [30.0, 60.0, 240.0] {
        let mut world = World::new(None, simulation, VirtualConfig::touch(), HandModel::FIRM);
        world.lead(UP, UP, 0.5, |world| assert_eq!(world.force(), [0.0; 3]));
        world.lead(UP, DOWN, 0.5, |_| {});
        world.lead(DOWN, DOWN, 2.0, |_| {});
        let spring = world.probe.config().stiffness;
        let (force, tool) = (world.force()[1], world.tool()[1]);
        let want = spring * (RADIUS - tool);
        println!("{simulation} Hz: {force:.4} N, the spring has {want:.4} N");
        assert!(want > 0.5 && (force / want - 1.0).abs() < 0.01, "{force} {want}");
    }
}

/// A tool's corners: that of a ball, and those of a capsule.
const TOOLS: [&[[f64; 3]]; 2] = [&[[0.0; 3]], &[[-0.02, 0.0, 0.0], [0.02, 0.0, 0.0]]];

#[test]
fn pressing_stroking_and_lifting_stay_passive_without_a_kick() {
    for (young, corners) in [2e4, 1e5, 1e6].into_iter().flat_map(|young| TOOLS.map(|tool| (young, tool))) {
        for simulation in [30.0, 60.0, 120.0, 240.0] {
            for hand in [HandModel::LIGHT, HandModel::FIRM] {
                let mut world = World::new(Some(young), simulation, VirtualConfig::touch(), hand);
                world.probe.set_corners(corners).unwrap();
                let name = format!("E {young:.0e}, {} corners, {simulation} Hz, {hand:?}", corners.len());
                world.lead(UP, UP, 0.5, |world| assert_eq!(world.force(), [0.0; 3], "{name}"));
                let mut pulled = 0.0f64;
                let (mut most, mut back) = (0.0f64, 0.0f64);
                world.lead(UP, DOWN, 0.5, |_| {});
                let side = [0.01, DOWN[1], 0.005];
                for _ in 0..3 {
                    world.lead(DOWN, side, 0.4, |world| most = most.max(norm(world.force())));
                    world.lead(side, DOWN, 0.4, |world| back = back.max(norm(world.force())));
                }
                world.lead(DOWN, UP, 0.5, |world| {
                    // Where planes meet, one pushes against the normal of another. Where they come
                    // and go, the passivity controller brakes the hand.
                    let shaped = corners.len() > 1;
                    let force = if shaped { world.cycle.core().last().wanted } else { world.force() };
                    let along = world
                        .normals
                        .iter()
                        .flatten()
                        .map(|normal| force.iter().zip(normal).map(|(f, n)| f * n).sum::<f64>());
                    pulled = pulled.min(along.reduce(f64::max).unwrap_or(0.0));
                });
                world.lead(UP, UP, 0.2, |_| {});
                println!(
                    "{name}: {most:.2} N, given {:.1e} J, pull {pulled:.1e} N, jump {:.3} of {:.3} N, \
                     wanted {:.3} N, {} guarded",
                    world.given,
                    world.jump,
                    slew(&world),
                    world.wish,
                    world.guarded
                );
                assert_eq!(world.force(), [0.0; 3], "{name}: free air is free");
                assert!(most > 0.05, "{name}: {most}");
                assert!(world.given <= 5e-3, "{name}: {}", world.given);
                assert!(pulled >= -1e-3, "{name}: {pulled}");
                assert!(world.jump <= slew(&world) * 1.000_001, "{name}: {}", world.jump);
                // The slew limit alone would let a kick of any size through as a ramp. What another
                // update brings takes an update, and the spring of the tool gives the rest.
                let all = most.max(back);
                let whole = if corners.len() == 1 { 0.75 * most } else { all };
                let bound = whole.min(1.5 * all * simulation * 1e-3 + 0.05);
                assert!(world.wish < bound, "{name}: {} of {most} and {back}", world.wish);
                // Over the closed way the hand has paid.
                assert!(world.cycle.device().work() <= 1e-6, "{name}: {}", world.cycle.device().work());
            }
        }
    }
}

/// Tools that lie in a valley with the lowest place where a ball touches both faces.
const IN_VALLEY: [(&str, &[[f64; 3]]); 6] = [
    ("ball", &[[0.0; 3]]),
    ("capsule along", &[[0.0, 0.0, -0.02], [0.0, 0.0, 0.02]]),
    ("capsule across", &[[-0.02, 0.02, 0.0], [0.02, 0.02, 0.0]]),
    ("end of a capsule", &[[0.0; 3], [0.0, 0.04, 0.0]]),
    (
        "edge of a box",
        &[
            [0.0, 0.0, -0.01],
            [0.01, 0.01, -0.01],
            [-0.01, 0.01, -0.01],
            [0.0, 0.02, -0.01],
            [0.0, 0.0, 0.01],
            [0.01, 0.01, 0.01],
            [-0.01, 0.01, 0.01],
            [0.0, 0.02, 0.01],
        ],
    ),
    ("top of a hull", &[[0.0; 3], [0.01, 0.03, 0.01], [-0.01, 0.03, 0.01], [0.0, 0.03, -0.01]]),
];

/// In a groove the hand feels what the simulation has, and leaves it without a kick.
#[test]
fn a_tool_in_a_groove_feels_what_the_simulation_has() {
    let at = [0.0, VALLEY + RADIUS * (2f64.sqrt() - 1.0), 0.0];
    for (young, (tool, corners)) in
        [2e4, 1e6].into_iter().flat_map(|young| IN_VALLEY.map(|tool| (young, tool)))
    {
        let model = Arc::new(valley(young));
        let hands = [(HandModel::LIGHT, 0.0), (HandModel::FIRM, 0.5)];
        for (simulation, (hand, friction)) in
            [30.0, 60.0, 240.0].into_iter().flat_map(|rate| hands.map(|hand| (rate, hand)))
        {
            let mut world = World::above(at, Some(model.clone()), simulation, VirtualConfig::touch(), hand);
            world.probe.set_corners(corners).unwrap();
            world.probe.configure(ProbeConfig { friction, ..*world.probe.config() }).unwrap();
            let name = format!("{tool}, E {young:.0e}, {simulation} Hz, friction {friction}");
            world.lead(UP, UP, 0.5, |_| {});
            world.lead(UP, DOWN, 0.5, |_| {});
            world.lead(DOWN, DOWN, 2.0, |_| {});
            // Smallest and largest force of the loop and of the simulation, N.
            let mut felt = [[f64::INFINITY, 0.0f64]; 2];
            let before = world.guarded;
            world.lead(DOWN, DOWN, 1.0, |world| {
                for (felt, now) in felt.iter_mut().zip([world.force(), world.probe.force()]) {
                    *felt = [felt[0].min(norm(now)), felt[1].max(norm(now))];
                }
            });
            let (most, guarded) = (felt[0][1], world.guarded - before);
            for _ in 0..2 {
                let side = [0.01, DOWN[1], 0.005];
                world.lead(DOWN, side, 0.4, |_| {});
                world.lead(side, DOWN, 0.4, |_| {});
            }
            let inside = std::mem::take(&mut world.wish);
            world.lead(DOWN, UP, 0.5, |_| {});
            world.lead(UP, UP, 0.2, |_| {});
            let work = world.cycle.device().work();
            println!(
                "{name}: loop {:.3} to {:.3} N, simulation {:.3} to {:.3} N, {guarded} guarded, wanted \
                 {inside:.3} N inside and {:.3} N on the way out, given {:.1e} J, in the end {work:.1e} J",
                felt[0][0], felt[0][1], felt[1][0], felt[1][1], world.wish, world.given
            );
            // They differ where it sticks, and with more planes than the loop has room for.
            let same = felt.iter().flatten().all(|f| (f / most - 1.0).abs() < 0.05);
            assert!(same && most > 0.2, "{name}: {felt:?}");
            assert!(felt.iter().all(|[least, most]| most - least < 0.01 * most), "{name}: {felt:?}");
            assert_eq!(world.force(), [0.0; 3], "{name}: free air is free");
            assert!(world.given <= 5e-3 && work <= 1e-6, "{name}: {} {work}", world.given);
            assert!(inside.max(world.wish) < 0.25 * most, "{name}: {inside} and {}", world.wish);
        }
    }
}

#[test]
fn a_hand_that_rests_on_a_body_is_calm() {
    for (young, corners) in [2e4, 1e5, 1e6].into_iter().flat_map(|young| TOOLS.map(|tool| (young, tool))) {
        for simulation in [30.0, 60.0, 120.0, 240.0] {
            for hand in [HandModel::LIGHT, HandModel::FIRM] {
                let mut world = World::new(Some(young), simulation, VirtualConfig::touch(), hand);
                world.probe.set_corners(corners).unwrap();
                world.lead(UP, DOWN, 0.5, |_| {});
                world.lead(DOWN, DOWN, 3.0, |_| {});
                let mut fastest = 0.0f64;
                world.lead(DOWN, DOWN, 1.0, |world| {
                    let v = world.cycle.device().velocity();
                    fastest = fastest.max(v.iter().map(|v| v * v).sum::<f64>().sqrt());
                });
                println!(
                    "E {young:.0e}, {} corners, {simulation} Hz, {hand:?}: {:.2} mm/s, {:?} N",
                    corners.len(),
                    1e3 * fastest,
                    world.force()
                );
                assert!(fastest < 5e-3, "{young} {simulation} {hand:?}: {fastest}");
            }
        }
    }
}

#[test]
fn a_touch_at_half_a_meter_a_second_is_no_kick() {
    for young in [None, Some(2e4), Some(1e6)] {
        let mut world = World::new(young, 60.0, VirtualConfig::touch(), HandModel::FIRM);
        world.lead(UP, UP, 0.5, |_| {});
        world.lead(UP, DOWN, 0.036 / 0.5, |_| {});
        world.lead(DOWN, DOWN, 0.3, |_| {});
        println!(
            "{young:?}: largest change {:.3} N of {:.3} N, wanted {:.3} N",
            world.jump,
            slew(&world),
            world.wish
        );
        assert!(world.jump > 0.0 && world.jump <= slew(&world) * 1.000_001);
        assert!(world.wish < 0.5, "{young:?}: {}", world.wish);
    }
}

#[test]
fn bad_planes_give_no_force_and_a_fault() {
    let mut world = World::new(None, 60.0, VirtualConfig::touch(), HandModel::FIRM);
    world.lead(UP, DOWN, 0.5, |_| {});
    assert!(world.force()[1] > 0.1);
    for bad in [f64::NAN, f64::INFINITY] {
        let mut model = world.model.clone();
        model.tick += 1;
        model.plane_count = MAX_PLANES + 3;
        model.planes[0].normal = [0.0, bad, 0.0];
        assert!(!model.is_finite());
    }
    world.model.planes[0].velocity = [f64::NAN; 3];
    world.model.tick += 1;
    world.next = f64::INFINITY;
    world.lead(DOWN, DOWN, 0.2, |world| assert!(world.force().iter().all(|f| f.is_finite())));
    assert_eq!(world.force(), [0.0; 3]);
    assert!(world.cycle.core().last().fault.is_some());
}
