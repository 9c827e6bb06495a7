//! The loop on its own thread, and the ends of the queues that the app holds.

use std::{
    collections::VecDeque,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use triple_buffer::TripleBuffer;

use crate::{
    Coupling, Cycle, DeviceInfo, Fault, HapticDevice, LocalModel, LoopClock, LoopConfig, LoopEvent,
    LoopReport, LoopState, ModalLocal, RealScheduler, Record, StartError, ToolMap, Wrench,
    control_loop::{
        cycle::Sink,
        heartbeat::{Done, Heartbeat, Phase},
        stop::StopSwitch,
        supervisor::supervise,
    },
};

/// Maximum number of events that wait to be read. Further events are dropped, but the fault
/// counters of the report still count.
const EVENTS: usize = 256;
/// Maximum number of records that wait to be read: one second at 8 kHz.
const RECORDS: usize = 8192;
/// Maximum number of commands that wait to be processed.
const COMMANDS: usize = 64;
/// Longest time that the end of a loop waits for its thread.
const GOODBYE: Duration = Duration::from_millis(500);
/// Time without a sign of life after which a loop without a supervisor is reported as hung, s.
const HUNG: f64 = 0.1;

enum LoopCommand {
    Tool(ToolMap),
    Modal(Option<Box<ModalLocal>>),
    ResetStop,
    Record(bool),
}

/// A running device and its loop. Dropping the value stops both.
///
/// The app writes the local model with [`publish`](Self::publish) and reads the
/// [`report`](Self::report). Neither side ever waits for the other. The loop does not lock,
/// allocate or drop shared memory: a body that it stepped goes back to the app to be dropped.
///
/// A driver that panics ends only its own loop. From then on, the report contains
/// [`LoopState::Ended`] and [`Fault::Panicked`] without a force, and the events are sent once.
///
/// A driver that does not return from `exchange` loses its force: a supervisor on another thread
/// cuts it by the device's [`StopHandle`](crate::StopHandle) 25 ms after the last sign of life. The
/// report then contains [`LoopState::Hung`] and [`Fault::Hung`] until the driver returns, and the
/// force comes back by the ramp. The end of such a loop leaves the thread behind after half a
/// second.
pub struct HapticLoop {
    model: triple_buffer::Input<LocalModel>,
    report: triple_buffer::Output<LoopReport>,
    commands: rtrb::Producer<LoopCommand>,
    events: rtrb::Consumer<LoopEvent>,
    records: rtrb::Consumer<Record>,
    trash: rtrb::Consumer<Box<ModalLocal>>,
    stop: StopSwitch,
    quit: Arc<AtomicBool>,
    heartbeat: Arc<Heartbeat>,
    /// Whether the present hang has been sent as an event.
    hang_sent: bool,
    thread: Option<JoinHandle<()>>,
    /// Time at which the thread was asked to quit.
    asked: Option<Instant>,
    /// `dead` is set if the thread has ended by itself. `final_events` then holds the events about
    /// its end.
    dead: bool,
    final_events: VecDeque<LoopEvent>,
    clock: LoopClock,
    info: DeviceInfo,
    coupling: Coupling,
    rate: f64,
}

impl HapticLoop {
    /// Starts the loop of `device` on its own thread, with FIFO priority where the system allows it
    /// and with a warning where the system does not.
    ///
    /// # Errors
    /// Returns an error if a number is out of range, if a real device lacks a part of the safety
    /// pipeline, or if no thread could be created.
    pub fn start(device: impl HapticDevice + 'static, config: LoopConfig) -> Result<Self, StartError> {
        let cycle = Cycle::new(device, config)?;
        let info = cycle.core().info().clone();
        let coupling = *cycle.core().coupling();
        if coupling.is_clamped() {
            tracing::info!(device = info.name, "coupling: {coupling}");
        }
        let (model, model_out) = TripleBuffer::new(&LocalModel::default()).split();
        let (report_in, report) = TripleBuffer::new(&LoopReport::default()).split();
        let (commands, command_out) = rtrb::RingBuffer::new(COMMANDS);
        let (event_in, events) = rtrb::RingBuffer::new(EVENTS);
        let (record_in, records) = rtrb::RingBuffer::new(RECORDS);
        let (trash_in, trash) = rtrb::RingBuffer::new(COMMANDS);
        let stop = StopSwitch::new();
        let quit = Arc::new(AtomicBool::new(false));
        let clock = LoopClock::start();
        let heartbeat = Heartbeat::new(clock.now());
        if let Some(handle) = cycle.device().stop_handle() {
            let (heartbeat, stop, name) = (heartbeat.clone(), stop.clone(), info.name.clone());
            std::thread::Builder::new()
                .name("pliant supervisor".into())
                .spawn(move || {
                    // Above the loop's own priority, so that a driver that spins cannot starve it.
                    // The loop warns if it is not allowed.
                    let _ = raise_priority(SUPERVISOR_PRIORITY);
                    supervise(&heartbeat, &handle, &stop, clock, &name);
                })
                .map_err(|error| StartError::Thread(error.to_string()))?;
        }
        let done = Done(heartbeat.clone());
        let inner = Inner {
            cycle,
            model: model_out,
            report: report_in,
            commands: command_out,
            trash: trash_in,
            queues: Queues { events: event_in, records: record_in, recording: false },
            stop: stop.clone(),
            quit: quit.clone(),
            heartbeat: heartbeat.clone(),
        };
        let thread = std::thread::Builder::new()
            .name("pliant haptics".into())
            .spawn(move || {
                // If the thread could not be created, this ends the supervisor as well.
                let _done = done;
                inner.run(clock, config.rate);
            })
            .map_err(|error| StartError::Thread(error.to_string()))?;
        Ok(Self {
            model,
            report,
            commands,
            events,
            records,
            trash,
            stop,
            quit,
            heartbeat,
            hang_sent: false,
            thread: Some(thread),
            asked: None,
            dead: false,
            final_events: VecDeque::new(),
            clock,
            info,
            coupling,
            rate: config.rate,
        })
    }

    /// Returns the device's description of itself at the start of the loop.
    pub fn info(&self) -> &DeviceInfo {
        &self.info
    }

    /// Returns the coupling that was in force when the loop started, and the wanted coupling.
    pub fn coupling(&self) -> &Coupling {
        &self.coupling
    }

    /// Returns the rate that the loop was started with, Hz.
    pub fn rate(&self) -> f64 {
        self.rate
    }

    /// Returns the time on the loop's clock, s. [`LocalModel::stamp`] is in this time.
    pub fn now(&self) -> f64 {
        self.clock.now()
    }

    /// Publishes a local model update. `write` fills the model in place, which still has the
    /// content of some earlier update. The model then goes to the loop.
    pub fn publish<R>(&mut self, write: impl FnOnce(&mut LocalModel) -> R) -> R {
        let result = write(self.model.input_buffer_mut());
        self.model.publish();
        result
    }

    /// Returns the newest report of the loop.
    pub fn report(&mut self) -> &LoopReport {
        while self.trash.pop().is_ok() {}
        self.look_after();
        if !self.dead {
            self.report.update();
            self.look_at_hang();
        }
        self.report.output_buffer()
    }

    /// Detects that the driver does not return. The thread cannot write a report then, so this
    /// method marks the last one. The next report of the thread replaces it.
    fn look_at_hang(&mut self) {
        let (silent, cut) = self.heartbeat.silence(self.clock.now());
        let hangs = !self.heartbeat.is(Phase::Opening) && (cut || silent > HUNG);
        if !hangs {
            self.hang_sent = false;
            return;
        }
        let fault = Fault::Hung(silent);
        if !self.hang_sent && self.final_events.len() < EVENTS {
            self.final_events.push_back(LoopEvent::Fault(fault));
        }
        self.hang_sent = true;
        let report = self.report.output_buffer_mut();
        (report.state, report.rate, report.tick.fault) = (LoopState::Hung, 0.0, Some(fault));
        if cut {
            (report.tick.wrench, report.tick.gain) = (Wrench::ZERO, 0.0);
        }
    }

    /// Detects that the thread has ended because the driver panicked. The thread can no longer
    /// write a report, and its last report shows no fault. This method therefore writes the final
    /// one.
    fn look_after(&mut self) {
        let ended = self.thread.as_ref().is_some_and(JoinHandle::is_finished);
        if self.dead || !ended || self.quit.load(Ordering::Acquire) {
            return;
        }
        self.dead = true;
        tracing::error!(
            device = self.info.name,
            serial = self.info.serial,
            "the device's driver panicked: its force is off and its loop is over; take the device away and add it anew"
        );
        self.report.update();
        let report = self.report.output_buffer_mut();
        let down = report.tick.buttons;
        self.final_events.extend((0..32).filter(|bit| down >> bit & 1 == 1).map(LoopEvent::Released));
        self.final_events.extend([LoopEvent::Fault(Fault::Panicked), LoopEvent::Lost]);
        let count = &mut report.faults[Fault::Panicked.kind()];
        *count = count.saturating_add(1);
        (report.state, report.rate) = (LoopState::Ended, 0.0);
        let tick = &mut report.tick;
        (tick.wrench, tick.wanted, tick.gain) = (Wrench::ZERO, [0.0; 3], 0.0);
        (tick.velocity, tick.tool_velocity, tick.buttons) = ([0.0; 3], [0.0; 3], 0);
        tick.fault = Some(Fault::Panicked);
    }

    /// Returns the events since the last call, oldest first.
    pub fn events(&mut self) -> impl Iterator<Item = LoopEvent> + '_ {
        self.look_after();
        std::iter::from_fn(|| self.events.pop().ok().or_else(|| self.final_events.pop_front()))
    }

    /// Moves the workspace in the world. Returns `false` if the map is invalid, or if the queue is
    /// full because the loop has not processed earlier commands yet. In the latter case the caller
    /// should retry.
    pub fn set_tool(&mut self, map: ToolMap) -> bool {
        map.is_valid() && self.commands.push(LoopCommand::Tool(map)).is_ok()
    }

    /// Sets or removes the body that the loop steps itself. Returns `false` if the queue is full
    /// because the loop has not processed earlier commands yet. The caller should then retry.
    pub fn set_modal(&mut self, modal: Option<Box<ModalLocal>>) -> bool {
        self.commands.push(LoopCommand::Modal(modal)).is_ok()
    }

    /// Cuts the force at the loop's next period, or by the supervisor if the driver does not
    /// answer. The stop is latched.
    pub fn emergency_stop(&self) {
        self.stop.press();
    }

    /// Returns the emergency stop switch, for other threads.
    pub fn stop_switch(&self) -> StopSwitch {
        self.stop.clone()
    }

    /// Unlatches the emergency stop. The force then rises by the ramp. If the result is `false`,
    /// because the loop has not processed earlier commands yet, the stop stays pressed, and the
    /// caller should retry.
    pub fn reset_stop(&mut self) -> bool {
        let has_room = self.can_reset_stop();
        self.stop.reset(has_room, || self.commands.push(LoopCommand::ResetStop).is_ok())
    }

    /// Whether [`reset_stop`](Self::reset_stop) would unlatch the emergency stop, because the loop
    /// has room for the command. Only calls to this loop take that room.
    pub fn can_reset_stop(&self) -> bool {
        !self.commands.is_full()
    }

    /// Starts or stops the recording of every period, see [`records`](Self::records).
    pub fn set_recording(&mut self, on: bool) -> bool {
        self.commands.push(LoopCommand::Record(on)).is_ok()
    }

    /// Returns the records since the last call, oldest first. If they are not read for a second or
    /// so, the newest records are lost.
    pub fn records(&mut self) -> impl Iterator<Item = Record> + '_ {
        std::iter::from_fn(|| self.records.pop().ok())
    }
}

impl HapticLoop {
    /// Asks the thread to end and does not wait. The drop then waits for what is left of its time.
    pub fn ask_to_end(&mut self) {
        self.look_after();
        self.asked.get_or_insert_with(Instant::now);
        self.quit.store(true, Ordering::Release);
    }

    /// Ends the loop and its device, as a drop does. Returns `false` if the driver did not return
    /// within half a second. Its thread is then left behind, with its force cut, and closes the
    /// device as soon as the driver returns.
    pub fn close(mut self) -> bool {
        self.end()
    }

    fn end(&mut self) -> bool {
        self.ask_to_end();
        let Some(thread) = self.thread.take() else { return true };
        let deadline = self.asked.unwrap_or_else(Instant::now) + GOODBYE;
        while !thread.is_finished() {
            if Instant::now() >= deadline {
                tracing::error!(
                    device = self.info.name,
                    serial = self.info.serial,
                    "the device's driver does not return: its thread is left behind"
                );
                return false;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        if thread.join().is_err() && !self.dead {
            tracing::error!(device = self.info.name, "the device's driver panicked at the end");
        }
        true
    }
}

impl Drop for HapticLoop {
    fn drop(&mut self) {
        self.end();
    }
}

impl std::fmt::Debug for HapticLoop {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("HapticLoop")
            .field("info", &self.info)
            .field("rate", &self.rate)
            .finish_non_exhaustive()
    }
}

struct Queues {
    events: rtrb::Producer<LoopEvent>,
    records: rtrb::Producer<Record>,
    recording: bool,
}

impl Sink for Queues {
    fn event(&mut self, event: LoopEvent) {
        // A full queue means that nobody reads it. The fault counters of the report still count.
        let _ = self.events.push(event);
    }

    fn record(&mut self, record: &Record) {
        if self.recording {
            let _ = self.records.push(*record);
        }
    }
}

struct Inner<D> {
    cycle: Cycle<D>,
    model: triple_buffer::Output<LocalModel>,
    report: triple_buffer::Input<LoopReport>,
    commands: rtrb::Consumer<LoopCommand>,
    trash: rtrb::Producer<Box<ModalLocal>>,
    queues: Queues,
    stop: StopSwitch,
    quit: Arc<AtomicBool>,
    heartbeat: Arc<Heartbeat>,
}

impl<D: HapticDevice> Inner<D> {
    /// Runs until the app asks the thread to quit or the driver panics. In both cases the force is
    /// cut at the end.
    fn run(mut self, clock: LoopClock, rate: f64) {
        // After a panic the device is only stopped and dropped, each in its own call. A driver that
        // panics again there must not abort the process, as a panic within a panic would.
        let _ = catch_unwind(AssertUnwindSafe(|| self.go_round(clock, rate)));
        let _ = catch_unwind(AssertUnwindSafe(|| self.cycle.device_mut().safe_stop()));
    }

    fn go_round(&mut self, clock: LoopClock, rate: f64) {
        let realtime = raise_priority(LOOP_PRIORITY);
        if let Err(error) = &realtime {
            tracing::warn!(
                "the haptic loop runs without real-time priority ({error}); under load its periods will be late. On Linux, allow it with \
                 RLIMIT_RTPRIO (in limits.conf: `@audio - rtprio 60`) or CAP_SYS_NICE"
            );
        }
        self.cycle.set_realtime(realtime.is_ok());
        let mut scheduler = RealScheduler::new(clock, rate);
        let stop = self.stop.clone();
        while !self.quit.load(Ordering::Acquire) {
            stop.obey(self, Self::obey_all, |this| this.cycle.emergency_stop());
            if !self.trash.is_full()
                && let Some(old) = self.cycle.take_trash()
            {
                let _ = self.trash.push(old);
            }
            let phase = match self.cycle.report().state {
                LoopState::Running | LoopState::ForceOff => Phase::Armed,
                LoopState::Lost => Phase::Opening,
                _ => Phase::Safe,
            };
            if self.heartbeat.beat(clock.now(), phase) {
                tracing::warn!(device = self.cycle.core().info().name, "the driver answers again");
            }
            let report = *self.cycle.step(&mut scheduler, self.model.read(), &mut self.queues);
            self.report.write(report);
        }
    }

    /// Obeys the app's commands, as long as there is room for what comes back to it.
    fn obey_all(&mut self) {
        while !self.trash.is_full()
            && let Ok(command) = self.commands.pop()
        {
            self.obey(command);
        }
    }

    fn obey(&mut self, command: LoopCommand) {
        match command {
            LoopCommand::Tool(map) => {
                self.cycle.set_tool(map);
            }
            LoopCommand::Modal(modal) => {
                if let Some(old) = self.cycle.set_modal(modal) {
                    // The queue has room: the caller checked it before it took the command.
                    let _ = self.trash.push(old);
                }
            }
            LoopCommand::ResetStop => self.cycle.reset_stop(),
            LoopCommand::Record(on) => self.queues.recording = on,
        }
    }
}

/// FIFO priority of a loop: the middle of the range, above the desktop and below the kernel's own
/// threads.
const LOOP_PRIORITY: u8 = 50;
/// FIFO priority of a supervisor.
const SUPERVISOR_PRIORITY: u8 = 60;

/// Raises this thread to FIFO priority, above all ordinary threads.
///
/// # Errors
/// Returns the system's reason if this is not allowed.
fn raise_priority(priority: u8) -> Result<(), String> {
    #[cfg(unix)]
    let result = {
        use thread_priority::{
            RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
            set_thread_priority_and_policy, thread_native_id,
        };
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        match thread_priority::ThreadPriorityValue::try_from(priority) {
            Ok(value) => set_thread_priority_and_policy(
                thread_native_id(),
                ThreadPriority::Crossplatform(value),
                policy,
            )
            .map_err(|error| format!("{error:?}")),
            Err(error) => Err(error.to_string()),
        }
    };
    #[cfg(not(unix))]
    let result = {
        let _ = priority;
        thread_priority::ThreadPriority::Max.set_for_current().map_err(|error| format!("{error:?}"))
    };
    result
}
