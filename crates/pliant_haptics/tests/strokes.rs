//! A thin capsule that strokes an ear and a horn, with the loop of a virtual device.

use crate::rig;

use pliant_haptics::{HandModel, VirtualConfig};
use pliant_modal::{Islands, Together};
use rig::world::{DOWN, GAP, UP, World, norm, slew};

/// Ends of a capsule that lies from one ear to the other, and of one across, m.
const CAPSULES: [(&str, [[f64; 3]; 2]); 2] =
    [("along x", [[-0.02, 0.0, 0.0], [0.02, 0.0, 0.0]]), ("along z", [[0.0, 0.0, -0.02], [0.0, 0.0, 0.02]])];

/// Where a stroke turns that begins at `DOWN`, m.
const WAYS: [(&str, [f64; 3]); 4] = [
    ("to x", [0.01, DOWN[1], 0.0]),
    ("to -x", [-0.01, DOWN[1], 0.0]),
    ("to z", [0.0, DOWN[1], 0.01]),
    ("aslant", [0.01, DOWN[1], 0.005]),
];

/// The planes of a tool that goes over an edge come and go, give more or less from one update to
/// the next, and turn. The hand feels another force then, but not at once: from one force to
/// another it takes an update.
#[test]
fn a_thin_capsule_strokes_an_ear_without_a_kick() {
    let all = [2e4, 1e5, 1e6].into_iter().flat_map(|young| CAPSULES.map(|capsule| (young, capsule)));
    let all = all.flat_map(|(young, capsule)| WAYS.map(|way| (young, capsule, way)));
    let rates = [
        (60.0, HandModel::LIGHT),
        (60.0, HandModel::FIRM),
        (120.0, HandModel::LIGHT),
        (120.0, HandModel::FIRM),
    ];
    let (mut kicks, mut paid, mut rows) = (Vec::new(), 0.0, 0);
    for ((young, (lies, corners), (goes, side)), (simulation, hand)) in
        all.flat_map(|row| rates.map(|rate| (row, rate)))
    {
        let mut world = World::new(Some(young), simulation, VirtualConfig::touch(), hand);
        world.probe.set_corners(&corners).unwrap();
        let mut most = 0.0f64;
        world.lead(UP, UP, 0.1, |_| {});
        world.lead(UP, DOWN, 0.5, |world| most = most.max(norm(world.force())));
        world.lead(DOWN, side, 0.4, |world| most = most.max(norm(world.force())));
        world.lead(side, DOWN, 0.4, |world| most = most.max(norm(world.force())));
        world.lead(DOWN, UP, 0.5, |world| most = most.max(norm(world.force())));
        world.lead(UP, UP, 0.2, |_| {});
        let work = world.cycle.device().work();
        let name = format!("E {young:.0e}, {lies}, {goes}, {simulation} Hz, {} kg", hand.mass);
        println!(
            "{name}: {most:.3} N, wanted {:.3} N, given {:.1e} J, in the end {work:.1e} J",
            world.wish, world.given
        );
        assert_eq!(world.force(), [0.0; 3], "{name}: free air is free");
        assert!(most > 0.05, "{name}: {most}");
        assert!(world.jump <= slew(&world) * 1.000_001, "{name}: {}", world.jump);
        // Over the closed way the hand has paid.
        assert!(work <= 1e-6 && world.given <= 5e-3, "{name}: {work} J, given {} J", world.given);
        // What the spring of the tool gives in a period is the rest.
        let bound = 1.5 * most * simulation * 1e-3 + 0.05;
        if world.wish > bound {
            kicks.push(format!("{name}: {:.3} N in a period, may be {bound:.3} N", world.wish));
        }
        paid -= work;
        rows += 1;
    }
    println!("the hand pays {:.2e} J on a way", paid / f64::from(rows));
    assert!(kicks.is_empty(), "{} of {rows} ways:\n{}", kicks.len(), kicks.join("\n"));
}

/// Above the tip of a horn, whose faces meet there at nearly right angles, a capsule feels the
/// tip from where it touches it, and the force grows with the way.
#[test]
fn a_capsule_comes_down_on_a_tip() {
    for (lies, corners) in CAPSULES {
        for rate in [60.0, 120.0, 1000.0] {
            let mut world = World::new(Some(1e6), rate, VirtualConfig::touch(), HandModel::LIGHT);
            world.probe.set_corners(&corners).unwrap();
            let mut body = world.body.take().unwrap();
            let above = world.probe.target();
            let mut islands = Islands::default();
            let (mut last, mut change, mut guarded, mut touched) = (0.0, 0.0f64, 0, None);
            // From 2 mm above the tip to 3 mm below where it touches.
            let way = 2.5e-5;
            for k in 0..200 {
                let height = 0.002 - way * f64::from(k);
                world.probe.set_target([above[0], above[1] - GAP + height, above[2]]).unwrap();
                let mut bodies = [Together::new(7, &mut body)];
                let probes = std::slice::from_mut(&mut world.probe);
                islands.step_with(&mut bodies, probes, 1.0 / rate, |_, _| false, |_, _| true);
                guarded += usize::from(bodies[0].body.contacts().report().guarded);
                let force = norm(world.probe.force());
                if force > 0.0 {
                    touched.get_or_insert(height);
                }
                (change, last) = (change.max((force - last).abs()), force);
            }
            let spring = world.probe.config().stiffness;
            println!(
                "{lies} at {rate} Hz: touched at {:.3?} mm, {last:.3} N, changed by {change:.4} N, the spring \
                 by {:.4} N, {guarded} guarded",
                touched.map(|height| 1e3 * height),
                spring * way
            );
            let at = touched.unwrap();
            assert!(at.abs() < 2.0 * way, "{lies} at {rate} Hz: touched at {at} m");
            // The dent takes some of the way, and a sudden touch some of the first step.
            let due = spring * 0.003;
            assert!(last > 0.8 * due && last < 1.05 * due, "{lies} at {rate} Hz: {last} N of {due} N");
            assert!(change < 3.0 * spring * way, "{lies} at {rate} Hz: {change} N in a step");
        }
    }
}
