//! A tool's ball that touches in the loop, with a virtual device in virtual time.

use crate::rig;

use std::sync::Arc;

use pliant_haptics::{
    Cycle, HandModel, LocalModel, LoopConfig, LoopEvent, MAX_PLANES, ModelWriter, SafetyConfig, ToolMap,
    TouchBall, TouchPlane, VirtualConfig, VirtualDevice, VirtualHandle, VirtualScheduler,
};
use pliant_modal::{Body, BodyConfig, Islands, ModalModel, Plane, Probe, ProbeConfig, Together};
use rig::{
    baked::{made_of, pip, top},
    valley::{VALLEY, valley},
};

/// A body of 15 cm or a rigid floor, a probe, and a loop whose workspace is 3 cm above the top.
struct World {
    body: Option<Body>,
    probe: Probe,
    islands: Islands,
    writer: ModelWriter,
    cycle: Cycle<VirtualDevice>,
    hand: VirtualHandle,
    scheduler: VirtualScheduler,
    model: LocalModel,
    events: Vec<LoopEvent>,
    step: f64,
    next: f64,
    /// Number of steps that were begun anew with implicit contacts.
    guarded: usize,
    /// Largest change of the force in a period and largest work of the motors so far, N and J.
    jump: f64,
    /// Largest change in a period of the force that is wanted before the safety stages, N.
    wish: f64,
    given: f64,
    last: [[f64; 3]; 2],
    /// Normals of the planes of this update and of the last one, whose planes may still leave.
    normals: [Vec<[f64; 3]>; 2],
}

const GAP: f64 = 0.03;
const RADIUS: f64 = 0.01;

impl World {
    fn new(young: Option<f64>, simulation: f64, device: VirtualConfig, hand: HandModel) -> Self {
        let model = young.map(|young| Arc::new(made_of(&pip(), young, 0.15)));
        let at = model
            .as_ref()
            .map_or([0.0; 3], |model| model.surface().positions()[top(model) as usize].map(f64::from));
        Self::above(at, model, simulation, device, hand)
    }

    /// A world whose workspace is above a point, m, of the body.
    fn above(
        at: [f64; 3],
        model: Option<Arc<ModalModel>>,
        simulation: f64,
        device: VirtualConfig,
        hand: HandModel,
    ) -> Self {
        let device = VirtualDevice::new(device, hand).unwrap();
        let hand = device.handle();
        let origin = [at[0], at[1] + RADIUS + GAP, at[2]];
        let tool = ToolMap { origin, ..ToolMap::default() };
        let cycle = Cycle::new(device, LoopConfig { tool, ..LoopConfig::default() }).unwrap();
        let spring = cycle.core().coupling().grab_config(1.0, 1.0);
        let config = ProbeConfig {
            radius: RADIUS,
            stiffness: spring.stiffness.unwrap(),
            relaxation: spring.relaxation,
            friction: 0.5,
        };
        let mut probe = Probe::new(config, origin).unwrap();
        if model.is_none() {
            probe.set_obstacles(vec![Arc::new(Plane::GROUND)]).unwrap();
        }
        let step = 1.0 / simulation;
        let make = |model: Arc<ModalModel>| {
            let mut body = Body::new(model, BodyConfig { step, ..BodyConfig::default() }).unwrap();
            body.set_friction(0.5).unwrap();
            body
        };
        Self {
            body: model.map(make),
            probe,
            islands: Islands::default(),
            writer: ModelWriter::new(),
            cycle,
            hand,
            scheduler: VirtualScheduler::new(1000.0),
            model: LocalModel::default(),
            events: Vec::new(),
            step,
            next: 0.0,
            guarded: 0,
            jump: 0.0,
            wish: 0.0,
            given: 0.0,
            last: [[0.0; 3]; 2],
            normals: [const { Vec::new() }; 2],
        }
    }

    fn tick(&mut self) {
        let now = self.scheduler.now();
        while now >= self.next - 1e-12 {
            self.next += self.step;
            let seen = *self.cycle.core().last();
            if seen.now > 0.0 {
                self.probe.set_target(seen.tool).unwrap();
                self.probe.set_rotation(seen.tool_orientation).unwrap();
            }
            let mut bodies: Vec<_> = self.body.iter_mut().map(|body| Together::new(7, body)).collect();
            let probes = std::slice::from_mut(&mut self.probe);
            self.islands.step_with(&mut bodies, probes, self.step, |_, _| false, |_, _| true);
            assert!(bodies.iter().all(|body| body.error.is_none()));
            self.guarded += bodies.iter().filter(|body| body.body.contacts().report().guarded).count();
            let config = *self.probe.config();
            let ball = TouchBall {
                radius: config.radius,
                stiffness: config.stiffness,
                relaxation: config.relaxation,
                lever: self.probe.lever(),
            };
            // What pushes comes first, as in the plugin.
            let mut touched = self.probe.contacts().to_vec();
            touched.sort_by(|a, b| norm(b.force).total_cmp(&norm(a.force)));
            let planes = touched.iter().map(|c| TouchPlane {
                key: 7,
                spot: c.spot,
                point: c.point,
                normal: c.normal,
                velocity: c.velocity,
                compliance: c.compliance,
                friction: c.friction,
            });
            let stored = self.body.as_ref().map_or(0.0, Body::energy);
            self.model.interval = self.step;
            self.writer.write_touch(ball, planes, stored, self.step, seen.now, &mut self.model);
            self.normals.swap(0, 1);
            self.normals[0] = self.model.planes().iter().map(|plane| plane.normal).collect();
        }
        self.cycle.step(&mut self.scheduler, &self.model, &mut self.events);
        let now = [self.force(), self.cycle.core().last().wanted];
        let [sent, wanted] = [0, 1].map(|which| {
            let pairs = now[which].iter().zip(self.last[which]);
            pairs.map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
        });
        (self.jump, self.wish, self.last) = (self.jump.max(sent), self.wish.max(wanted), now);
        self.given = self.given.max(self.cycle.device().work());
    }

    fn force(&self) -> [f64; 3] {
        self.cycle.core().last().wrench.force
    }

    fn tool(&self) -> [f64; 3] {
        self.cycle.core().last().tool
    }

    /// Leads the hand to a place in a time, s, and calls `each` after every period.
    fn lead(&mut self, from: [f64; 3], to: [f64; 3], seconds: f64, mut each: impl FnMut(&Self)) {
        let ticks = (seconds * 1000.0) as u32;
        for k in 1..=ticks {
            let s = f64::from(k) / f64::from(ticks);
            self.hand.set_target(std::array::from_fn(|i| from[i] + s * (to[i] - from[i])));
            self.tick();
            each(self);
        }
    }
}

const UP: [f64; 3] = [0.0; 3];
const DOWN: [f64; 3] = [0.0, -GAP - 0.006, 0.0];

fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn slew(world: &World) -> f64 {
    SafetyConfig::for_device(world.cycle.core().info(), 1000.0).slew.unwrap() / 1000.0
}

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
                // The slew limit alone would let a kick of any size through as a ramp.
                // Several planes of a sharp horn may turn the force of a capsule at once.
                let bound = if corners.len() == 1 { 0.75 * most } else { most.max(back) };
                assert!(world.wish < bound, "{name}: {} of {most} and {back}", world.wish);
                // Over the closed way the hand has paid.
                assert!(world.cycle.device().work() <= 1e-6, "{name}: {}", world.cycle.device().work());
            }
        }
    }
}

/// Tools that lie in a valley with the lowest place where a ball touches both faces.
const IN_VALLEY: [(&str, &[[f64; 3]]); 5] = [
    ("ball", &[[0.0; 3]]),
    ("capsule along", &[[0.0, 0.0, -0.02], [0.0, 0.0, 0.02]]),
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
