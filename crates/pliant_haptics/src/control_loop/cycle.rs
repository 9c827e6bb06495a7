//! One period of the loop with a device: exchange, tick, bookkeeping, loss and return. The thread
//! runs it in real time, and tests run it in virtual time.

use std::time::Instant;

use crate::{
    Calibration, Coupling, Fault, HapticDevice, Histogram, LocalModel, LoopConfig, LoopCore, LoopTick,
    ModalLocal, Sample, Scheduler, StartError, ToolMap, Wrench,
};

/// Time of continuous driver errors after which a device counts as lost, s.
const PATIENCE: f64 = 0.1;
/// Interval of the attempts to reopen a lost device, s.
const RETRY: f64 = 1.0;

/// State of the loop and its device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum LoopState {
    /// The loop sends forces.
    #[default]
    Running,
    /// The device waits for its calibration. There is no force.
    Calibrating,
    /// The device is lost, and the loop tries to reopen it, unless the emergency stop is latched.
    /// There is no force.
    Lost,
    /// The emergency stop is latched. There is no force.
    Stopped,
    /// The force is switched off at the device. It comes back by the ramp.
    ForceOff,
    /// A call of the driver does not return. The supervisor has cut the force, if the device has a
    /// [`StopHandle`](crate::StopHandle).
    Hung,
    /// The driver has panicked, and the loop has ended. There is no force until the device is added
    /// again.
    Ended,
}

/// Report of the loop about itself, once per period.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LoopReport {
    /// The newest tick.
    pub tick: LoopTick,
    /// State of the loop and its device.
    pub state: LoopState,
    /// Number of periods so far.
    pub ticks: u64,
    /// Number of missed periods so far.
    pub missed: u64,
    /// Periods per second over the last half second, Hz. It is 0 in the first half second.
    pub rate: f64,
    /// Lateness of the ends of the periods.
    pub lateness: Histogram,
    /// Work time of the loop per period, from the sample to the wrench.
    pub work: Histogram,
    /// Whether the thread has real-time priority.
    pub realtime: bool,
    /// Number of times that each kind of fault has begun, indexed by [`Fault::kind`].
    pub faults: [u32; Fault::KINDS],
    /// The coupling in force.
    pub coupling: Option<Coupling>,
}

/// An event of the loop, in order of occurrence.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum LoopEvent {
    /// The button with this bit number went down.
    Pressed(u32),
    /// The button with this bit number came up, or its device was lost.
    Released(u32),
    /// A fault began.
    Fault(Fault),
    /// The last fault is over, and the force ramps up.
    Clear,
    /// The device was lost, and the loop tries to reopen it. After a [`Fault::Panicked`] the loop
    /// does not.
    Lost,
    /// The device came back.
    Returned,
    /// The user must do something by hand before positions are valid, as the text says.
    Calibrate(&'static str),
}

/// The record of one period.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Record {
    /// Time on the loop's clock, s.
    pub now: f64,
    /// Length of the period, s.
    pub dt: f64,
    /// The sample that the device returned.
    pub sample: Sample,
    /// The wrench that the device gets next.
    pub wrench: Wrench,
}

/// Receiver of events and records: the queues of the thread, or the lists of a test.
pub trait Sink {
    /// Takes an event. Must not block.
    fn event(&mut self, event: LoopEvent);

    /// Takes the record of a period. Must not block.
    fn record(&mut self, record: &Record);
}

impl Sink for () {
    fn event(&mut self, _: LoopEvent) {}
    fn record(&mut self, _: &Record) {}
}

impl Sink for Vec<LoopEvent> {
    fn event(&mut self, event: LoopEvent) {
        self.push(event);
    }
    fn record(&mut self, _: &Record) {}
}

/// A loop and its device, driven from outside period by period.
pub struct Cycle<D> {
    core: LoopCore,
    config: LoopConfig,
    device: D,
    wrench: Wrench,
    report: LoopReport,
    fault: Option<usize>,
    failing_since: Option<f64>,
    retry_at: f64,
    calibrate_at: f64,
    calibrated: bool,
    reported: Option<&'static str>,
    stopped: bool,
    counted_from: (f64, u64),
    /// A copy of a body that the loop has discarded.
    trash: Option<Box<ModalLocal>>,
}

impl<D: HapticDevice> Cycle<D> {
    /// Creates a cycle for a device and a configuration. Nothing is exchanged yet.
    ///
    /// # Errors
    /// Returns the errors of [`LoopCore::new`].
    pub fn new(device: D, config: LoopConfig) -> Result<Self, StartError> {
        let core = LoopCore::new(device.info(), config)?;
        let report = LoopReport { coupling: Some(*core.coupling()), ..LoopReport::default() };
        Ok(Self {
            core,
            config,
            device,
            wrench: Wrench::ZERO,
            report,
            fault: None,
            failing_since: None,
            retry_at: 0.0,
            calibrate_at: 0.0,
            calibrated: false,
            reported: None,
            stopped: false,
            counted_from: (0.0, 0),
            trash: None,
        })
    }

    /// Returns the core of the loop.
    pub fn core(&self) -> &LoopCore {
        &self.core
    }

    /// Returns the device.
    pub fn device(&self) -> &D {
        &self.device
    }

    /// Returns mutable access to the device, which serves to manipulate the device in a test.
    pub fn device_mut(&mut self) -> &mut D {
        &mut self.device
    }

    /// Returns the report of the loop.
    pub fn report(&self) -> &LoopReport {
        &self.report
    }

    pub(crate) fn set_realtime(&mut self, realtime: bool) {
        self.report.realtime = realtime;
    }

    /// Cuts the force at once and until [`reset_stop`](Self::reset_stop).
    pub fn emergency_stop(&mut self) {
        self.core.emergency_stop();
        if !self.stopped {
            self.stopped = true;
            self.wrench = Wrench::ZERO;
            self.device.safe_stop();
        }
    }

    /// Unlatches the emergency stop.
    pub fn reset_stop(&mut self) {
        self.stopped = false;
        self.core.reset_stop();
    }

    /// Moves the workspace in the world. An invalid map is refused, and the old map stays.
    pub fn set_tool(&mut self, map: ToolMap) -> bool {
        let ok = self.core.set_tool(map);
        if ok {
            self.config.tool = map;
        }
        ok
    }

    /// Sets or removes the body that the loop steps itself, and returns the previous one.
    pub fn set_modal(&mut self, modal: Option<Box<ModalLocal>>) -> Option<Box<ModalLocal>> {
        self.core.set_modal(modal)
    }

    /// Returns a copy of a body that the loop discarded by itself, because another device with
    /// another coupling came back. The caller should drop the copy where the drop may take time,
    /// and give the loop a new copy.
    pub fn take_trash(&mut self) -> Option<Box<ModalLocal>> {
        self.trash.take()
    }

    /// Returns whether the loop has a body to step.
    pub fn has_modal(&self) -> bool {
        self.core.has_modal()
    }

    /// Runs one period.
    pub fn step(
        &mut self,
        scheduler: &mut dyn Scheduler,
        model: &LocalModel,
        sink: &mut dyn Sink,
    ) -> &LoopReport {
        let before = scheduler.last().now;
        if self.report.state == LoopState::Lost {
            scheduler.wait();
            self.look_for(scheduler.last().now, sink);
            let fault = if self.report.state == LoopState::Lost { Fault::Gone } else { Fault::NotCalibrated };
            self.finish(scheduler, Err(fault), model, sink, Instant::now());
            return &self.report;
        }
        if !self.calibrated {
            self.calibrate(before, sink);
        }
        let wrench = if self.calibrated { self.wrench } else { Wrench::ZERO };
        let answer = self.device.exchange(&wrench, scheduler);
        let begun = Instant::now();
        if scheduler.last().now <= before || scheduler.last().dt < 0.25 / self.config.rate {
            // A failing driver does not wait, nor does a driver that has lost its clock. A thread
            // of this priority must not spin on either.
            scheduler.wait();
        }
        let answer = match answer {
            Ok(sample) if self.calibrated => Ok(sample),
            Ok(_) => Err(Fault::NotCalibrated),
            Err(fault) => Err(fault),
        };
        self.finish(scheduler, answer, model, sink, begun);
        &self.report
    }

    fn finish(
        &mut self,
        scheduler: &mut dyn Scheduler,
        answer: Result<Sample, Fault>,
        model: &LocalModel,
        sink: &mut dyn Sink,
        begun: Instant,
    ) {
        let period = scheduler.last();
        let (now, dt) = (period.now, period.dt);
        self.wrench = match &answer {
            Ok(sample) => {
                self.failing_since = None;
                let wrench = self.core.tick(now, dt, sample, model);
                sink.record(&Record { now, dt, sample: *sample, wrench });
                wrench
            }
            Err(fault) => self.core.miss(now, dt, *fault, model),
        };
        if answer == Err(Fault::NotCalibrated) && self.calibrated && self.report.state != LoopState::Lost {
            // The device has lost its reference, for example because its power went off and on.
            self.calibrated = false;
            self.calibrate_at = now;
        }
        if let Err(fault) = answer
            && self.report.state != LoopState::Lost
            && fault != Fault::NotCalibrated
        {
            let since = *self.failing_since.get_or_insert(now);
            if fault == Fault::Gone || now - since > PATIENCE {
                self.lose(now, sink);
            }
        }
        self.report.work.add(begun.elapsed().as_secs_f64());
        self.report.lateness.add(period.late);
        self.report.ticks += 1;
        self.report.missed += u64::from(period.missed);
        let (from, ticks) = self.counted_from;
        if now - from >= 0.5 {
            self.report.rate = (self.report.ticks - ticks) as f64 / (now - from);
            self.counted_from = (now, self.report.ticks);
        }
        self.notify(sink);
        self.report.tick = *self.core.last();
        if self.report.state != LoopState::Lost {
            self.report.state = if self.core.is_stopped() {
                LoopState::Stopped
            } else if !self.calibrated {
                LoopState::Calibrating
            } else if self.core.last().fault == Some(Fault::ForceOff) {
                LoopState::ForceOff
            } else {
                LoopState::Running
            };
        }
    }

    /// Sends changes of buttons and faults as events.
    fn notify(&mut self, sink: &mut dyn Sink) {
        let tick = *self.core.last();
        let changed = tick.buttons ^ self.report.tick.buttons;
        for bit in (0..32).filter(|bit| changed >> bit & 1 == 1) {
            let down = tick.buttons >> bit & 1 == 1;
            sink.event(if down { LoopEvent::Pressed(bit) } else { LoopEvent::Released(bit) });
        }
        let kind = tick.fault.map(|f| f.kind());
        if kind != self.fault {
            self.fault = kind;
            match tick.fault {
                Some(fault) => {
                    let count = &mut self.report.faults[fault.kind()];
                    *count = count.saturating_add(1);
                    sink.event(LoopEvent::Fault(fault));
                }
                None => sink.event(LoopEvent::Clear),
            }
        }
    }

    fn calibrate(&mut self, now: f64, sink: &mut dyn Sink) {
        if now < self.calibrate_at {
            return;
        }
        self.calibrate_at = now + 0.25;
        match self.device.calibration() {
            Calibration::Ready => {
                self.calibrated = true;
                self.reported = None;
                self.core.engage();
            }
            Calibration::Needed(what) => {
                if self.reported != Some(what) {
                    sink.event(LoopEvent::Calibrate(what));
                }
                self.reported = Some(what);
            }
        }
    }

    fn lose(&mut self, now: f64, sink: &mut dyn Sink) {
        self.device.safe_stop();
        self.core.lose();
        self.report.state = LoopState::Lost;
        self.failing_since = None;
        self.retry_at = now + RETRY;
        sink.event(LoopEvent::Lost);
    }

    fn look_for(&mut self, now: f64, sink: &mut dyn Sink) {
        // A device may drive by itself when it is opened, so a stopped one stays closed until the
        // stop is reset.
        if now < self.retry_at || self.core.is_stopped() {
            return;
        }
        self.retry_at = now + RETRY;
        if self.device.reopen().is_err() {
            return;
        }
        let info = self.device.info();
        if info != *self.core.info() {
            // The returned device is a different one. The loop runs with its limits, or the device
            // stays lost.
            let Ok(mut core) = LoopCore::new(info, self.config) else { return };
            // The copy of the body stays, unless the coupling of the new device differs. In that
            // case the proxy serves until the app sets a new copy.
            let copy = self.core.set_modal(None);
            if core.coupling() == self.core.coupling() {
                core.set_modal(copy);
            } else {
                self.trash = copy.or(self.trash.take());
            }
            self.core = core;
            self.report.coupling = Some(*self.core.coupling());
        }
        self.calibrated = false;
        self.calibrate_at = now;
        self.report.state = LoopState::Calibrating;
        sink.event(LoopEvent::Returned);
    }
}

impl<D> std::fmt::Debug for Cycle<D> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Cycle").field("core", &self.core).finish_non_exhaustive()
    }
}

impl<D: HapticDevice + ?Sized> HapticDevice for Box<D> {
    fn info(&self) -> crate::DeviceInfo {
        (**self).info()
    }
    fn pacing(&self) -> crate::Pacing {
        (**self).pacing()
    }
    fn calibration(&mut self) -> Calibration {
        (**self).calibration()
    }
    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        (**self).exchange(wrench, scheduler)
    }
    fn safe_stop(&mut self) {
        (**self).safe_stop();
    }
    fn stop_handle(&self) -> Option<std::sync::Arc<dyn crate::StopHandle>> {
        (**self).stop_handle()
    }
    fn reopen(&mut self) -> Result<(), Fault> {
        (**self).reopen()
    }
}
