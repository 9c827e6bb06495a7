//! The haptic loop on a virtual device in virtual time: known limits, a body dragged by stiff,
//! loose and absent hands, and one that a device without friction holds.

use std::{collections::VecDeque, sync::Arc};

use nalgebra::{Matrix3, Vector3};
use pliant_haptics::{
    Cycle, HandModel, HeldGrab, LocalModel, LoopConfig, LoopEvent, ModelWriter, SafetyConfig, ToolContact,
    ToolMap, VirtualConfig, VirtualDevice, VirtualScheduler,
};
use pliant_modal::{Body, BodyConfig, GrabConfig};

use super::{
    Bound, Case, CaseOutcome,
    bodies::BarBody,
    solid::{Solid, lame},
};
use crate::LabError;

/// Periods a second of the device loop.
const RATE: f64 = 1000.0;
/// Steps a second of the simulation, if no other is named.
const STEPS: f64 = 120.0;
/// Time from the tool to the simulation and back over a network, s.
const FAR: f64 = 0.196;
/// Largest energy that the loop may give beyond its supply, J: the capacity of its tank.
const TANK: f64 = 5e-3;

pub(super) fn cases(out: &mut Vec<Case>) {
    for (mass, damping) in [(0.2, 0.5), (0.1, 0.2)] {
        let name = format!("sampled spring, {mass} kg, {damping} N s/m: stable to 2 b / T");
        out.push(Case::new("device", name, move || sampled_spring(mass, damping)));
    }
    for young in [1e3, 1e5, 1e7, 1e11] {
        for (grip, hand) in HandModel::PRESETS {
            for round_trip in [0.0, FAR] {
                let far = if round_trip > 0.0 { ", 196 ms away" } else { "" };
                let name = format!("E {young:.0e} Pa, grip {grip}{far}, 120 Hz");
                out.push(Case::new("device", name, move || drag(young, hand, STEPS, round_trip)));
                if young > 1e3 {
                    let name = format!("no friction, E {young:.0e} Pa, grip {grip}{far}, 120 Hz");
                    out.push(Case::new("device", name, move || hold(young, hand, round_trip)));
                }
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

/// The bar that is dragged.
fn dragged(young: f64) -> BarBody {
    BarBody { young, length: 0.15, modes: 12, zeta: 0.05, ..BarBody::default() }
}

/// A body stepped at the game's rate, a network with a fixed delay, and the device loop with a
/// virtual device.
struct DeviceScene {
    body: Body,
    /// Where the tool is when it does not deform the body, m.
    origin: Vector3<f64>,
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
    fn new(
        device: VirtualConfig,
        young: f64,
        hand: HandModel,
        simulation: f64,
        round_trip: f64,
    ) -> Result<Self, LabError> {
        let bar = dragged(young);
        let model = bar.bake()?;
        let patch = bar.tip(&model)?;
        let step = 1.0 / simulation;
        let mut body = Body::new(Arc::clone(&model), BodyConfig { step, ..BodyConfig::default() })?;
        let probe = body.grab(&patch, GrabConfig::default())?;
        // The middle of the workspace lies on the patch, so that grabbing moves nothing.
        let origin = body.grab_position(probe)?;
        body.release(probe);
        let device = VirtualDevice::new(device, hand)?;
        let tool = ToolMap { origin, ..ToolMap::default() };
        let cycle = Cycle::new(device, LoopConfig { rate: RATE, round_trip, tool, ..LoopConfig::default() })?;
        let id = body.grab(&patch, cycle.core().coupling().grab_config(1.0, 1.0))?;
        Ok(Self {
            body,
            origin: origin.into(),
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

/// Leads the arm `to` (m) within half a second and lets the device come to rest. Without a hand,
/// the free device gets an initial velocity instead. Returns the bounds on what it does.
fn led(scene: &mut DeviceScene, hand: HandModel, to: Vector3<f64>) -> Result<Vec<Bound>, LabError> {
    scene.largest_speed(0.5)?;
    if hand == HandModel::NONE {
        let at = scene.cycle.device().position();
        scene.cycle.device_mut().place(at, [0.1, 0.05, 0.0]);
    } else {
        let arm = scene.cycle.device().handle();
        for k in 1..=500 {
            arm.set_target((crate::smooth(f64::from(k) / 500.0) * to).into());
            scene.tick()?;
        }
    }
    scene.largest_speed(3.0)?;
    let late = scene.largest_speed(0.5)?;
    Ok(vec![
        // Below half a centimeter a second nobody feels the motion.
        Bound::new("speed of the tool 3.5 s after the pull / m/s", late, 5e-3),
        Bound::new("energy given beyond what was put in / J", scene.given, TANK),
    ])
}

/// Drags the tool of a virtual Touch 3 cm to the side.
fn drag(young: f64, hand: HandModel, simulation: f64, round_trip: f64) -> Result<CaseOutcome, LabError> {
    let mut scene = DeviceScene::new(VirtualConfig::touch(), young, hand, simulation, round_trip)?;
    Ok(CaseOutcome::of(led(&mut scene, hand, Vector3::new(0.02, 0.02, -0.01))?))
}

/// Pulls a device without friction 2 mm to the side, so that the loop alone calms it. What the
/// spring of the arm feels along the pull is then the force of the coupling in series with the full
/// finite elements. Across it, a soft bar that is held in all directions also pulls by what its
/// bending shortens it (a quarter to a third of the force at 1e5 Pa), which no linear solution has.
fn hold(young: f64, hand: HandModel, round_trip: f64) -> Result<CaseOutcome, LabError> {
    let device = VirtualConfig { friction: 0.0, ..VirtualConfig::touch() };
    let mut scene = DeviceScene::new(device, young, hand, STEPS, round_trip)?;
    let to = Vector3::new(0.0, 2e-3, 0.0);
    let mut bounds = led(&mut scene, hand, to)?;
    if hand == HandModel::NONE {
        return Ok(CaseOutcome::of(bounds));
    }
    let ticks = 500;
    let (mut felt, mut away) = (0.0, Vector3::zeros());
    for _ in 0..ticks {
        scene.tick()?;
        let device = Vector3::from(scene.cycle.device().position());
        felt += hand.stiffness * (to - device).y / f64::from(ticks);
        away += (Vector3::from(scene.cycle.core().last().tool) - scene.origin) / f64::from(ticks);
    }
    let (bar, model) = (dragged(young), scene.body.model());
    let solid = Solid::new(&bar.mesh()?, bar.element, lame(young, bar.poisson), 1e-9);
    let compliance = solid.compliance(model.surface(), &bar.tip(model)?);
    let series = compliance + Matrix3::identity() / scene.cycle.core().coupling().stiffness;
    let want = series.try_inverse().map_or(f64::NAN, |stiffness| (stiffness * away).y);
    // Over a network, some grips keep coming and going within a step or two of the encoder, and
    // what is averaged depends on when.
    let most = if round_trip > 0.0 { 0.05 } else { 0.01 };
    bounds.push(Bound::new("|force at rest / that of coupling and solid - 1|", felt / want - 1.0, most));
    Ok(CaseOutcome::of(bounds))
}
