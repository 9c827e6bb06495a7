//! A body stepped at the game's rate, a network of a fixed delay, and the loop with a virtual
//! device, all in virtual time.

use std::{collections::VecDeque, sync::Arc};

use pliant_haptics::{
    Cycle, HandModel, HeldGrab, LocalModel, LoopConfig, LoopEvent, ModalLocal, ModelWriter, ToolMap,
    VirtualConfig, VirtualDevice, VirtualHandle, VirtualScheduler,
};
use pliant_modal::{Body, BodyConfig, ModalModel, Patch, StepSettings};

use super::{
    baked::{made_of, top},
    block::{block, tip},
};

pub struct Scene {
    pub body: Body,
    pub held: HeldGrab,
    writer: ModelWriter,
    pub cycle: Cycle<VirtualDevice>,
    pub hand: VirtualHandle,
    pub scheduler: VirtualScheduler,
    pub model: LocalModel,
    pub events: Vec<LoopEvent>,
    step: f64,
    one_way: f64,
    next_step: f64,
    targets: VecDeque<(f64, f64, [f64; 3])>,
    seen: f64,
    models: VecDeque<(f64, LocalModel)>,
    /// Whether the simulation is suspended: the game is paused, late or gone.
    pub silent: bool,
    /// Largest change of the force in a period, N.
    pub largest_step: f64,
    /// Largest excess so far of the motors' work over the supplied energy, J.
    pub most_given: f64,
    last_force: [f64; 3],
}

/// The body that is dragged.
#[derive(Clone)]
pub enum Subject {
    /// The block whose modes are known in closed form, dragged by its tip.
    Block,
    /// A baked body scaled to 15 cm, dragged by its top.
    Baked(Arc<ModalModel>),
}

pub struct SceneConfig {
    pub subject: Subject,
    pub young: f64,
    pub modes: usize,
    pub device: VirtualConfig,
    pub hand: HandModel,
    pub rate: f64,
    pub simulation: f64,
    pub round_trip: f64,
    pub modal: bool,
    /// Gravity that gives the body this weight, N, along -y.
    pub weight: f64,
}

impl Default for SceneConfig {
    fn default() -> Self {
        Self {
            subject: Subject::Block,
            young: 1e5,
            modes: 60,
            device: VirtualConfig::touch(),
            hand: HandModel::LIGHT,
            rate: 1000.0,
            simulation: 120.0,
            round_trip: 0.0,
            modal: false,
            weight: 0.0,
        }
    }
}

impl Scene {
    pub fn new(c: SceneConfig) -> Self {
        let (model, vertex, radius) = match &c.subject {
            Subject::Block => (block(c.young, c.modes), tip(), 0.01),
            Subject::Baked(baked) => (made_of(baked, c.young, 0.15), top(baked), 0.01),
        };
        let model = Arc::new(model);
        let step = 1.0 / c.simulation;
        let modes = Some(c.modes.min(model.mode_count()));
        let gravity = [0.0, -c.weight / model.mass(), 0.0];
        let settings = StepSettings { gravity, ..StepSettings::default() };
        let config = BodyConfig { step, modes, settings, ..BodyConfig::default() };
        let mut body = Body::new(model.clone(), config).unwrap();
        let device = VirtualDevice::new(c.device, c.hand).unwrap();
        let hand = device.handle();
        let patch = Patch::around(model.surface(), vertex, radius).unwrap();
        // The center of the workspace lies on the patch, so that grabbing moves nothing.
        let origin = {
            let mut probe = body.clone();
            let id = probe.grab(&patch, pliant_modal::GrabConfig::default()).unwrap();
            probe.grab_position(id).unwrap()
        };
        let config = LoopConfig {
            rate: c.rate,
            round_trip: c.round_trip,
            modal: c.modal,
            tool: ToolMap { origin, ..ToolMap::default() },
            ..LoopConfig::default()
        };
        let mut cycle = Cycle::new(device, config).unwrap();
        let id = body.grab(&patch, cycle.core().coupling().grab_config(1.0, 1.0)).unwrap();
        let held = HeldGrab { key: 0, id, offset: [0.0; 3] };
        if c.modal {
            cycle.set_modal(Some(Box::new(ModalLocal::new(&body, &[held], 1.0, c.rate).unwrap())));
        }
        Self {
            body,
            held,
            writer: ModelWriter::new(),
            cycle,
            hand,
            scheduler: VirtualScheduler::new(c.rate),
            model: LocalModel::default(),
            events: Vec::new(),
            step,
            one_way: 0.5 * c.round_trip,
            next_step: 0.0,
            targets: VecDeque::new(),
            seen: 0.0,
            models: VecDeque::new(),
            silent: false,
            largest_step: 0.0,
            most_given: 0.0,
            last_force: [0.0; 3],
        }
    }

    /// Runs one period of the loop, with the simulation steps and the messages that are due in it.
    pub fn tick(&mut self) {
        let now = self.scheduler.now();
        let newest = self.cycle.core().last();
        self.targets.push_back((now + self.one_way, newest.now, newest.tool));
        while now >= self.next_step - 1e-12 {
            self.next_step += self.step;
            if self.silent {
                continue;
            }
            while let Some(&(_, seen, target)) = self.targets.front().filter(|(at, ..)| *at <= now) {
                self.seen = seen;
                self.targets.pop_front();
                if self.cycle.core().last().now > 0.0 {
                    self.body.set_target(self.held.id, target).unwrap();
                }
            }
            self.body.step().unwrap();
            let mut local = LocalModel::default();
            self.writer
                .write(&self.body, &[self.held], self.cycle.core().coupling(), 1.0, self.seen, &mut local)
                .unwrap();
            self.models.push_back((now + self.one_way, local));
        }
        while self.models.front().is_some_and(|(at, _)| *at <= now) {
            self.model = self.models.pop_front().unwrap().1;
        }
        self.cycle.step(&mut self.scheduler, &self.model, &mut self.events);
        let force = self.cycle.core().last().wrench.force;
        let change: f64 = force.iter().zip(self.last_force).map(|(a, b)| (a - b).powi(2)).sum();
        self.largest_step = self.largest_step.max(change.sqrt());
        self.last_force = force;
        let supplied = self.cycle.core().last().port.supplied;
        self.most_given = self.most_given.max(self.cycle.device().work() - supplied);
    }

    pub fn run(&mut self, seconds: f64) {
        for _ in 0..(seconds * self.cycle.core().config().rate) as usize {
            self.tick();
        }
    }

    pub fn speed(&self) -> f64 {
        self.cycle.device().velocity().iter().map(|v| v * v).sum::<f64>().sqrt()
    }

    pub fn force(&self) -> f64 {
        self.cycle.core().last().wrench.force.iter().map(|v| v * v).sum::<f64>().sqrt()
    }

    /// Returns the largest speed of the hand over `seconds`, m/s.
    pub fn largest_speed(&mut self, seconds: f64) -> f64 {
        let mut worst = 0.0f64;
        for _ in 0..(seconds * self.cycle.core().config().rate) as usize {
            self.tick();
            worst = worst.max(self.speed());
        }
        worst
    }
}

/// Result of a drag.
pub struct Drag {
    /// Largest speed in two windows of half a second, 1 and 3 s after the hand stopped, m/s.
    pub speeds: [f64; 2],
    /// Largest excess of the motors' work over the supplied energy, J.
    pub given: f64,
    /// Largest change of the force in a period, N, and the limit.
    pub step: [f64; 2],
    /// Force at the end, N.
    pub force: f64,
}

impl Drag {
    /// Returns whether the oscillation is sustained. The hand still moves and is not much slower
    /// than two seconds before, or it is faster than a hand at rest can be.
    pub fn oscillates(&self) -> bool {
        let [early, late] = self.speeds;
        // The condition tests for calm, so that a NaN does not count as calm.
        let calm = late <= 5e-3 || (late <= 0.7 * early && late <= 20e-3);
        !calm
    }

    /// Returns whether there is no sustained oscillation, no energy beyond the supplied energy and
    /// the tank, and no force step above the slew limit.
    pub fn keeps_its_promises(&self) -> bool {
        !self.oscillates() && self.given <= 5e-3 && self.step[0] <= self.step[1] * 1.000_001
    }
}

/// Drags 3 cm to the side in half a second and holds still. Without a hand, the free device gets an
/// initial velocity instead.
pub fn drag(config: SceneConfig) -> Drag {
    let free = config.hand == HandModel::NONE;
    let mut scene = Scene::new(config);
    scene.run(0.5);
    if free {
        let at = scene.cycle.device().position();
        scene.cycle.device_mut().place(at, [0.1, 0.05, 0.0]);
    } else {
        let ticks = (0.5 * scene.cycle.core().config().rate) as u32;
        for k in 1..=ticks {
            let s = f64::from(k) / f64::from(ticks);
            let smooth = s * s * (3.0 - 2.0 * s);
            scene.hand.set_target([0.02 * smooth, 0.02 * smooth, -0.01 * smooth]);
            scene.tick();
        }
    }
    scene.run(1.0);
    let early = scene.largest_speed(0.5);
    scene.run(1.5);
    let late = scene.largest_speed(0.5);
    let slew =
        pliant_haptics::SafetyConfig::for_device(scene.cycle.core().info(), scene.cycle.core().config().rate)
            .slew;
    let limit = slew.unwrap() / scene.cycle.core().config().rate;
    Drag {
        speeds: [early, late],
        given: scene.most_given,
        step: [scene.largest_step, limit],
        force: scene.force(),
    }
}
