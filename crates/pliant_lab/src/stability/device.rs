//! The haptic loop on a virtual device in virtual time: known limits, and a body dragged by stiff,
//! loose and absent hands.

use std::{collections::VecDeque, sync::Arc};

use pliant_haptics::{
    Cycle, HandModel, HeldGrab, LocalModel, LoopConfig, LoopEvent, ModelWriter, SafetyConfig, ToolContact,
    ToolMap, VirtualConfig, VirtualDevice, VirtualScheduler,
};
use pliant_modal::{Body, BodyConfig, GrabConfig};

use super::{Bound, Case, CaseOutcome, bodies::BarBody};
use crate::LabError;

/// Periods a second of the device loop.
const RATE: f64 = 1000.0;
/// Largest energy that the loop may give beyond its supply, J: the capacity of its tank.
const TANK: f64 = 5e-3;

pub(super) fn cases(out: &mut Vec<Case>) {
    for (mass, damping) in [(0.2, 0.5), (0.1, 0.2)] {
        let name = format!("sampled spring, {mass} kg, {damping} N s/m: stable to 2 b / T");
        out.push(Case::new("device", name, move || sampled_spring(mass, damping)));
    }
    for young in [1e3, 1e5, 1e7, 1e11] {
        for (grip, hand) in HandModel::PRESETS {
            for round_trip in [0.0, 0.196] {
                let far = if round_trip > 0.0 { ", 196 ms away" } else { "" };
                let name = format!("E {young:.0e} Pa, grip {grip}{far}, 120 Hz");
                out.push(Case::new("device", name, move || drag(young, hand, 120.0, round_trip)));
            }
        }
    }
    for simulation in [40.0, 1000.0] {
        for (grip, hand) in [("loose", HandModel::LOOSE), ("none", HandModel::NONE)] {
            let name = format!("E 1e5 Pa, grip {grip}, {simulation} Hz");
            out.push(Case::new("device", name, move || drag(1e5, hand, simulation, 0.0)));
        }
    }
}

/// Returns whether a free device on a bare spring of `k` (N/m) comes to rest.
fn calms(device: &VirtualConfig, k: f64) -> Result<bool, LabError> {
    let config = LoopConfig { safety: Some(SafetyConfig::bare()), ..LoopConfig::default() };
    let mut cycle = Cycle::new(VirtualDevice::new(device.clone(), HandModel::NONE)?, config)?;
    let mut scheduler = VirtualScheduler::new(RATE);
    let mut events: Vec<LoopEvent> = Vec::new();
    let mut update = LocalModel::default();
    cycle.device_mut().place([1e-3, 0.0, 0.0], [0.0; 3]);
    let ticks = 3_000;
    let (mut early, mut late) = (0.0f64, 0.0f64);
    for t in 0..ticks {
        update.tick += 1;
        update.stamp = scheduler.now();
        update.period = 1.0 / RATE;
        update.count = 1;
        update.contacts[0] = ToolContact {
            stiffness: [[k, 0.0, 0.0], [0.0, k, 0.0], [0.0, 0.0, k]],
            damping: 0.0,
            ..ToolContact::default()
        };
        cycle.step(&mut scheduler, &update, &mut events);
        let x = cycle.device().position()[0];
        let energy = cycle.device().kinetic_energy() + 0.5 * k * x * x;
        match t * 10 / ticks {
            1 => early = early.max(energy),
            9 => late = late.max(energy),
            _ => {}
        }
    }
    Ok(late < early)
}

/// Finds the stiffest stable wall by bisection, to 0.2 %, and compares it with the known limit of a
/// sampled spring.
fn sampled_spring(mass: f64, damping: f64) -> Result<CaseOutcome, LabError> {
    let device = VirtualConfig { mass, damping, peak_force: 1e6, ..VirtualConfig::default() };
    let want = 2.0 * damping * RATE;
    let (mut low, mut high) = (0.5 * want, 2.0 * want);
    while high / low > 1.002 {
        let middle = 0.5 * (low + high);
        if calms(&device, middle)? { low = middle } else { high = middle }
    }
    Ok(CaseOutcome::of(vec![Bound::new("|stiffest calm spring / (2 b / T) - 1|", low / want - 1.0, 3e-3)]))
}

/// A body stepped at the game's rate, a network with a fixed delay, and the device loop with a
/// virtual Touch.
struct DeviceScene {
    body: Body,
    held: HeldGrab,
    writer: ModelWriter,
    cycle: Cycle<VirtualDevice>,
    scheduler: VirtualScheduler,
    update: LocalModel,
    events: Vec<LoopEvent>,
    step: f64,
    one_way: f64,
    next_step: f64,
    /// Arrival time, sample time and position of the tool.
    targets: VecDeque<(f64, f64, [f64; 3])>,
    seen: f64,
    updates: VecDeque<(f64, LocalModel)>,
    /// The largest energy that the motors have given beyond the supply, J.
    given: f64,
}

impl DeviceScene {
    fn new(young: f64, hand: HandModel, simulation: f64, round_trip: f64) -> Result<Self, LabError> {
        let bar = BarBody { young, length: 0.15, modes: 12, zeta: 0.05, ..BarBody::default() };
        let model = bar.bake()?;
        let patch = bar.tip(&model)?;
        let step = 1.0 / simulation;
        let mut body = Body::new(Arc::clone(&model), BodyConfig { step, ..BodyConfig::default() })?;
        let probe = body.grab(&patch, GrabConfig::default())?;
        // The middle of the workspace lies on the patch, so that grabbing moves nothing.
        let origin = body.grab_position(probe)?;
        body.release(probe);
        let device = VirtualDevice::new(VirtualConfig::touch(), hand)?;
        let tool = ToolMap { origin, ..ToolMap::default() };
        let cycle = Cycle::new(device, LoopConfig { rate: RATE, round_trip, tool, ..LoopConfig::default() })?;
        let id = body.grab(&patch, cycle.core().coupling().grab_config(1.0, 1.0))?;
        Ok(Self {
            body,
            held: HeldGrab { key: 0, id, offset: [0.0; 3] },
            writer: ModelWriter::new(),
            cycle,
            scheduler: VirtualScheduler::new(RATE),
            update: LocalModel::default(),
            events: Vec::new(),
            step,
            one_way: 0.5 * round_trip,
            next_step: 0.0,
            targets: VecDeque::new(),
            seen: 0.0,
            updates: VecDeque::new(),
            given: 0.0,
        })
    }

    /// Runs one period of the loop and every step that falls into it.
    fn tick(&mut self) -> Result<(), LabError> {
        let now = self.scheduler.now();
        let newest = self.cycle.core().last();
        self.targets.push_back((now + self.one_way, newest.now, newest.tool));
        while now >= self.next_step - 1e-12 {
            self.next_step += self.step;
            while let Some(&(_, seen, target)) = self.targets.front().filter(|(at, ..)| *at <= now) {
                self.seen = seen;
                self.targets.pop_front();
                if self.cycle.core().last().now > 0.0 {
                    self.body.set_target(self.held.id, target)?;
                }
            }
            self.body.step()?;
            let mut update = LocalModel::default();
            let coupling = self.cycle.core().coupling();
            self.writer.write(&self.body, &[self.held], coupling, 1.0, self.seen, &mut update)?;
            self.updates.push_back((now + self.one_way, update));
        }
        while self.updates.front().is_some_and(|(at, _)| *at <= now) {
            if let Some((_, update)) = self.updates.pop_front() {
                self.update = update;
            }
        }
        self.events.clear();
        self.cycle.step(&mut self.scheduler, &self.update, &mut self.events);
        let supplied = self.cycle.core().last().port.supplied;
        self.given = self.given.max(self.cycle.device().work() - supplied);
        Ok(())
    }

    /// Largest speed of the tool over `seconds`, m/s.
    fn largest_speed(&mut self, seconds: f64) -> Result<f64, LabError> {
        let mut worst = 0.0f64;
        for _ in 0..(seconds * RATE) as usize {
            self.tick()?;
            worst = worst.max(self.cycle.device().velocity().iter().map(|v| v * v).sum::<f64>().sqrt());
        }
        Ok(worst)
    }
}

/// Drags the tool 3 cm to the side within half a second and holds it there. Without a hand, the
/// free device gets an initial velocity instead.
fn drag(young: f64, hand: HandModel, simulation: f64, round_trip: f64) -> Result<CaseOutcome, LabError> {
    let mut scene = DeviceScene::new(young, hand, simulation, round_trip)?;
    scene.largest_speed(0.5)?;
    if hand == HandModel::NONE {
        let at = scene.cycle.device().position();
        scene.cycle.device_mut().place(at, [0.1, 0.05, 0.0]);
    } else {
        let arm = scene.cycle.device().handle();
        for k in 1..=500 {
            let s = crate::smooth(f64::from(k) / 500.0);
            arm.set_target([0.02 * s, 0.02 * s, -0.01 * s]);
            scene.tick()?;
        }
    }
    scene.largest_speed(1.0)?;
    scene.largest_speed(2.0)?;
    let late = scene.largest_speed(0.5)?;
    Ok(CaseOutcome::of(vec![
        // Below half a centimeter a second nobody feels the motion.
        Bound::new("speed of the tool 3.5 s after the pull / m/s", late, 5e-3),
        Bound::new("energy given beyond what was put in / J", scene.given, TANK),
    ]))
}
