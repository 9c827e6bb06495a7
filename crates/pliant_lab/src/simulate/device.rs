//! The haptic device of a member: a simulated one with its loop, which has a thread of its own.

use std::time::Duration;

use pliant_haptics::{
    Cycle, HandModel, LocalModel, LoopConfig, ModelWriter, PublishedGrab, SafetyConfig, ToolMap,
    VirtualConfig, VirtualDevice, VirtualHandle, VirtualScheduler,
};
use pliant_modal::ModalModel;

use super::{SPRING, hand, norm};

const PERIOD: Duration = Duration::from_millis(1);
/// Silence of the app from which there is no force, s.
const FADED: f64 = 0.05;
/// Rounding of the checks.
const ROUNDING: f64 = 1.0 + 1e-6;

/// What the devices of a session have done.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct DeviceRecord {
    /// Periods of the loops.
    pub(super) periods: u64,
    /// Largest force, N.
    pub(super) force: f64,
    /// Largest rise of a force in a period over the slew limit.
    pub(super) rise: f64,
}

impl DeviceRecord {
    pub(super) fn add(&mut self, other: Self) {
        self.periods += other.periods;
        (self.force, self.rise) = (self.force.max(other.force), self.rise.max(other.rise));
    }
}

/// A device, the hand on it, and its loop in virtual time.
pub(super) struct DeviceLoop {
    cycle: Cycle<VirtualDevice>,
    handle: VirtualHandle,
    scheduler: VirtualScheduler,
    model: LocalModel,
    writer: ModelWriter,
    process: usize,
    origin: [f64; 3],
    at: Duration,
    force: f64,
    /// The largest force, and the largest rise of it in a period, that the loop may let out, N.
    limits: [f64; 2],
}

impl DeviceLoop {
    /// A weak device for odd processes and a strong one for even ones, whose hand moves as that of
    /// the process from now on.
    pub(super) fn new(model: &ModalModel, process: usize, now: Duration) -> Result<Self, String> {
        let config = if process.is_multiple_of(2) { VirtualConfig::omega3() } else { VirtualConfig::touch() };
        let (_, [x, y, z]) = hand(model, process, Duration::ZERO);
        // The circle of the hand has its center at the center of the workspace.
        let origin = [x, y, z + 0.08];
        let mut device = VirtualDevice::new(config, HandModel::FIRM).map_err(|e| e.to_string())?;
        let (_, target) = hand(model, process, now);
        device.place(std::array::from_fn(|i| target[i] - origin[i]), [0.0; 3]);
        let handle = device.handle();
        let tool = ToolMap { origin, ..ToolMap::default() };
        let cycle = Cycle::new(device, LoopConfig { tool, ..LoopConfig::default() });
        let cycle = cycle.map_err(|e| e.to_string())?;
        let safety = SafetyConfig::for_device(cycle.core().info(), 1.0 / PERIOD.as_secs_f64());
        let limits = [safety.peak, safety.slew.map(|slew| slew * PERIOD.as_secs_f64())];
        Ok(Self {
            cycle,
            handle,
            scheduler: VirtualScheduler::new(1.0 / PERIOD.as_secs_f64()),
            model: LocalModel::default(),
            writer: ModelWriter::new(),
            process,
            origin,
            at: now,
            force: 0.0,
            limits: limits.map(|limit| ROUNDING * limit.unwrap_or(0.0)),
        })
    }

    /// Where the app has the tool, from the last report of the loop. Before the first one it is
    /// where the hand is.
    pub(super) fn tool(&self, hand: [f64; 3]) -> [f64; 3] {
        let report = self.cycle.report();
        if report.ticks == 0 { hand } else { report.tick.tool }
    }

    /// The app publishes what is displayed to a hand: its target and the reaction. Without it, the
    /// tool holds nothing that is known.
    pub(super) fn publish(&mut self, displayed: Option<([f64; 3], [f64; 3])>, step: f64) {
        let grab = displayed.map(|(target, reaction)| PublishedGrab {
            key: 1,
            point: std::array::from_fn(|i| target[i] + reaction[i] / SPRING),
            force: reaction,
            stiffness: std::array::from_fn(|r| std::array::from_fn(|c| if r == c { SPRING } else { 0.0 })),
            ..PublishedGrab::default()
        });
        let seen = self.cycle.report().tick.now;
        self.model.interval = step;
        self.writer.write_forces(grab.as_slice(), 0.0, 0.0, step, seen, &mut self.model);
    }

    /// Runs the loop until a time, in which its thread may stand still and the device may be gone.
    pub(super) fn run(
        &mut self,
        model: &ModalModel,
        until: Duration,
        [stalled, gone]: [bool; 2],
    ) -> Result<DeviceRecord, String> {
        let mut record = DeviceRecord::default();
        self.handle.set_gone(gone);
        while self.at + PERIOD <= until {
            self.at += PERIOD;
            if stalled {
                self.scheduler.stall(PERIOD.as_secs_f64());
                continue;
            }
            let (_, target) = hand(model, self.process, self.at);
            self.handle.set_target(std::array::from_fn(|i| target[i] - self.origin[i]));
            let tick = self.cycle.step(&mut self.scheduler, &self.model, &mut ()).tick;
            let force = norm(tick.wrench.force);
            let rise = force - std::mem::replace(&mut self.force, force);
            let [most, most_rise] = self.limits;
            // A comparison with a NaN holds for none.
            let holds = force <= most && rise <= most_rise && (tick.silent <= FADED || force == 0.0);
            if !holds {
                return Err(format!(
                    "{:.3} s: the device of process {} exerts {force:.3} N, {rise:.3} N more than before, after {:.3} s of silence",
                    self.at.as_secs_f64(),
                    self.process,
                    tick.silent
                ));
            }
            record.add(DeviceRecord { periods: 1, force, rise: rise / most_rise });
        }
        Ok(record)
    }
}
