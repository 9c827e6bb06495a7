//! The loop on its own thread, and the ends of the queues that the app holds.

use std::{
    collections::VecDeque,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
};

use triple_buffer::TripleBuffer;

use crate::{
    Coupling, Cycle, DeviceInfo, Fault, HapticDevice, LocalModel, LoopClock, LoopConfig, LoopEvent,
    LoopReport, LoopState, ModalLocal, RealScheduler, Record, StartError, ToolMap, Wrench,
    control_loop::cycle::Sink,
};

/// Events that wait to be read at most; more are dropped and counted.
const EVENTS: usize = 256;
/// Records that wait to be read at most: a second at 8 kHz.
const RECORDS: usize = 8192;
/// Commands that wait to be taken at most.
const COMMANDS: usize = 64;

enum Command {
    Tool(ToolMap),
    Modal(Option<Box<ModalLocal>>),
    ResetStop,
    Record(bool),
}

/// Presses the emergency stop of a loop, from any thread.
#[derive(Debug, Clone)]
pub struct StopSwitch(Arc<AtomicBool>);

impl StopSwitch {
    /// No force from the loop's next period on. Latched until [`HapticLoop::reset_stop`].
    pub fn press(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether it is pressed.
    pub fn is_pressed(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// A device and its loop, running. Dropping it stops both.
///
/// The app writes the simulation's word with [`publish`](Self::publish) and reads [`report`](Self::report); neither ever waits for the other side,
/// and the loop neither locks, nor allocates, nor drops shared memory (a body that it steps itself is handed back to be dropped here). What a
/// driver does within `exchange` is the driver's; one that panics ends its loop and nothing else: the report says [`LoopState::Ended`] and
/// [`Fault::Panicked`] from then on, without a force, and events tell it once.
pub struct HapticLoop {
    model: triple_buffer::Input<LocalModel>,
    report: triple_buffer::Output<LoopReport>,
    commands: rtrb::Producer<Command>,
    events: rtrb::Consumer<LoopEvent>,
    records: rtrb::Consumer<Record>,
    trash: rtrb::Consumer<Box<ModalLocal>>,
    stop: StopSwitch,
    quit: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    /// The thread has ended without having been asked to, and what there was to be said about it is in `last_words`.
    dead: bool,
    last_words: VecDeque<LoopEvent>,
    clock: LoopClock,
    info: DeviceInfo,
    coupling: Coupling,
    rate: f64,
}

impl HapticLoop {
    /// Starts the loop of `device` on a thread of its own, with FIFO priority where the system allows it and a warning where not.
    ///
    /// # Errors
    /// A number out of range, a real device without its whole safety pipeline, no thread to be had.
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
        let stop = StopSwitch(Arc::new(AtomicBool::new(false)));
        let quit = Arc::new(AtomicBool::new(false));
        let clock = LoopClock::start();
        let inner = Inner {
            cycle,
            model: model_out,
            report: report_in,
            commands: command_out,
            trash: trash_in,
            queues: Queues { events: event_in, records: record_in, recording: false },
            stop: stop.clone(),
            quit: quit.clone(),
        };
        let thread = std::thread::Builder::new()
            .name("pliant haptics".into())
            .spawn(move || inner.run(clock, config.rate))
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
            thread: Some(thread),
            dead: false,
            last_words: VecDeque::new(),
            clock,
            info,
            coupling,
            rate: config.rate,
        })
    }

    /// The device as it described itself when the loop started.
    pub fn info(&self) -> &DeviceInfo {
        &self.info
    }

    /// The coupling in force when the loop started, and what was wanted.
    pub fn coupling(&self) -> &Coupling {
        &self.coupling
    }

    /// Periods a second that it was started with, Hz.
    pub fn rate(&self) -> f64 {
        self.rate
    }

    /// The loop's clock, s: what [`LocalModel::stamp`] is given in.
    pub fn now(&self) -> f64 {
        self.clock.now()
    }

    /// Gives the simulation's word: `write` fills the model in place (it has the content of some earlier one), then it goes to the loop.
    pub fn publish<R>(&mut self, write: impl FnOnce(&mut LocalModel) -> R) -> R {
        let result = write(self.model.input_buffer_mut());
        self.model.publish();
        result
    }

    /// What the loop says about itself: the newest there is.
    pub fn report(&mut self) -> &LoopReport {
        while self.trash.pop().is_ok() {}
        self.look_after();
        if self.dead { self.report.output_buffer() } else { self.report.read() }
    }

    /// Notices that the thread has ended by itself: the driver has panicked. Its last report says that all is well, and nobody is left to write another.
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
        self.last_words.extend((0..32).filter(|bit| down >> bit & 1 == 1).map(LoopEvent::Released));
        self.last_words.extend([LoopEvent::Fault(Fault::Panicked), LoopEvent::Lost]);
        let count = &mut report.faults[Fault::Panicked.kind()];
        *count = count.saturating_add(1);
        (report.state, report.rate) = (LoopState::Ended, 0.0);
        let tick = &mut report.tick;
        (tick.wrench, tick.wanted, tick.gain) = (Wrench::ZERO, [0.0; 3], 0.0);
        (tick.velocity, tick.tool_velocity, tick.buttons) = ([0.0; 3], [0.0; 3], 0);
        tick.fault = Some(Fault::Panicked);
    }

    /// What has happened since the last call, oldest first.
    pub fn events(&mut self) -> impl Iterator<Item = LoopEvent> + '_ {
        self.look_after();
        std::iter::from_fn(|| self.events.pop().ok().or_else(|| self.last_words.pop_front()))
    }

    /// Moves the workspace in the world. `false`: the map is invalid or the loop has not taken earlier commands yet; ask again.
    pub fn set_tool(&mut self, map: ToolMap) -> bool {
        map.is_valid() && self.commands.push(Command::Tool(map)).is_ok()
    }

    /// Gives the loop a body to step itself, or takes it away. `false`: the loop has not taken earlier commands yet; ask again.
    pub fn set_modal(&mut self, modal: Option<Box<ModalLocal>>) -> bool {
        self.commands.push(Command::Modal(modal)).is_ok()
    }

    /// Cuts the force, at the loop's next period. Latched.
    pub fn emergency_stop(&self) {
        self.stop.press();
    }

    /// The switch, for other threads.
    pub fn stop_switch(&self) -> StopSwitch {
        self.stop.clone()
    }

    /// Unlatches the emergency stop; force comes back by the ramp. `false`: ask again.
    pub fn reset_stop(&mut self) -> bool {
        self.stop.0.store(false, Ordering::Release);
        self.commands.push(Command::ResetStop).is_ok()
    }

    /// Begins or ends the writing down of every period; see [`records`](Self::records).
    pub fn set_recording(&mut self, on: bool) -> bool {
        self.commands.push(Command::Record(on)).is_ok()
    }

    /// What has been written down since the last call, oldest first. Not read for a second or so, the newest are lost.
    pub fn records(&mut self) -> impl Iterator<Item = Record> + '_ {
        std::iter::from_fn(|| self.records.pop().ok())
    }
}

impl Drop for HapticLoop {
    fn drop(&mut self) {
        self.look_after();
        self.quit.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
            && !self.dead
        {
            tracing::error!(device = self.info.name, "the device's driver panicked at the end");
        }
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
        // Full: nobody reads them. The counters in the report still count.
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
    commands: rtrb::Consumer<Command>,
    trash: rtrb::Producer<Box<ModalLocal>>,
    queues: Queues,
    stop: StopSwitch,
    quit: Arc<AtomicBool>,
}

impl<D: HapticDevice> Inner<D> {
    /// Until it is told to quit or the driver panics; in either case the last thing is that the force is taken off.
    fn run(mut self, clock: LoopClock, rate: f64) {
        // What a panic leaves behind is only stopped and dropped, each on its own: a driver that panics at that too must not take the process with it,
        // as a panic within a panic would.
        let _ = catch_unwind(AssertUnwindSafe(|| self.go_round(clock, rate)));
        let _ = catch_unwind(AssertUnwindSafe(|| self.cycle.device_mut().safe_stop()));
    }

    fn go_round(&mut self, clock: LoopClock, rate: f64) {
        self.cycle.set_realtime(raise_priority());
        let mut scheduler = RealScheduler::new(clock, rate);
        while !self.quit.load(Ordering::Acquire) {
            // A switch that is pressed wins over a reset that is still in the queue.
            while !self.trash.is_full()
                && let Ok(command) = self.commands.pop()
            {
                self.obey(command);
            }
            if self.stop.is_pressed() {
                self.cycle.emergency_stop();
            }
            if !self.trash.is_full()
                && let Some(old) = self.cycle.take_trash()
            {
                let _ = self.trash.push(old);
            }
            let report = *self.cycle.step(&mut scheduler, self.model.read(), &mut self.queues);
            self.report.write(report);
        }
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Tool(map) => {
                self.cycle.set_tool(map);
            }
            Command::Modal(modal) => {
                if let Some(old) = self.cycle.set_modal(modal) {
                    // There is room: it was looked at before the command was taken.
                    let _ = self.trash.push(old);
                }
            }
            Command::ResetStop => self.cycle.reset_stop(),
            Command::Record(on) => self.queues.recording = on,
        }
    }
}

/// FIFO priority for this thread, above everything ordinary; `false`, with a warning that says what to do, where it is not allowed.
fn raise_priority() -> bool {
    #[cfg(unix)]
    let result = {
        use thread_priority::{
            RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
            set_thread_priority_and_policy, thread_native_id,
        };
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        // Half way up: above the desktop, below the kernel's own threads.
        match thread_priority::ThreadPriorityValue::try_from(50u8) {
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
    let result = thread_priority::ThreadPriority::Max.set_for_current().map_err(|error| format!("{error:?}"));
    match result {
        Ok(()) => true,
        Err(error) => {
            tracing::warn!(
                "the haptic loop runs without real-time priority ({error}); under load its periods will be late. On Linux, allow it with \
                 RLIMIT_RTPRIO (in limits.conf: `@audio - rtprio 60`) or CAP_SYS_NICE"
            );
            false
        }
    }
}
