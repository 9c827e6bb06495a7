//! A body, a probe and the loop with a virtual device, in virtual time.

use std::sync::Arc;

use pliant_haptics::{
    Cycle, HandModel, LocalModel, LoopConfig, LoopEvent, ModelWriter, SafetyConfig, ToolMap, TouchBall,
    TouchPlane, VirtualConfig, VirtualDevice, VirtualHandle, VirtualScheduler,
};
use pliant_modal::{Body, BodyConfig, Islands, ModalModel, Plane, Probe, ProbeConfig, Together};

use super::baked::{made_of, pip, top};

/// A body of 15 cm or a rigid floor, a probe, and a loop whose workspace is 3 cm above the top.
pub struct World {
    pub body: Option<Body>,
    pub probe: Probe,
    islands: Islands,
    writer: ModelWriter,
    pub cycle: Cycle<VirtualDevice>,
    hand: VirtualHandle,
    pub scheduler: VirtualScheduler,
    pub model: LocalModel,
    events: Vec<LoopEvent>,
    step: f64,
    pub next: f64,
    /// Number of steps that were begun anew with implicit contacts.
    pub guarded: usize,
    /// Largest change of the force in a period and largest work of the motors so far, N and J.
    pub jump: f64,
    /// Largest change in a period of the force that is wanted before the safety stages, N.
    pub wish: f64,
    pub given: f64,
    last: [[f64; 3]; 2],
    /// Normals of the planes of this update and of the last one, whose planes may still leave.
    pub normals: [Vec<[f64; 3]>; 2],
}

/// Way down from the center of the workspace to where a ball touches, m.
pub const GAP: f64 = 0.03;
pub const RADIUS: f64 = 0.01;

impl World {
    pub fn new(young: Option<f64>, simulation: f64, device: VirtualConfig, hand: HandModel) -> Self {
        let model = young.map(|young| Arc::new(made_of(&pip(), young, 0.15)));
        let at = model
            .as_ref()
            .map_or([0.0; 3], |model| model.surface().positions()[top(model) as usize].map(f64::from));
        Self::above(at, model, simulation, device, hand)
    }

    /// A world whose workspace is above a point, m, of the body.
    pub fn above(
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

    pub fn tick(&mut self) {
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

    pub fn force(&self) -> [f64; 3] {
        self.cycle.core().last().wrench.force
    }

    pub fn tool(&self) -> [f64; 3] {
        self.cycle.core().last().tool
    }

    /// Leads the hand to a place in a time, s, and calls `each` after every period.
    pub fn lead(&mut self, from: [f64; 3], to: [f64; 3], seconds: f64, mut each: impl FnMut(&Self)) {
        let ticks = (seconds * 1000.0) as u32;
        for k in 1..=ticks {
            let s = f64::from(k) / f64::from(ticks);
            self.hand.set_target(std::array::from_fn(|i| from[i] + s * (to[i] - from[i])));
            self.tick();
            each(self);
        }
    }
}

/// Where the hand is in free air, and where it presses, m.
pub const UP: [f64; 3] = [0.0; 3];
pub const DOWN: [f64; 3] = [0.0, -GAP - 0.006, 0.0];

pub fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// How much the force may change in a period, N.
pub fn slew(world: &World) -> f64 {
    SafetyConfig::for_device(world.cycle.core().info(), 1000.0).slew.unwrap() / 1000.0
}
