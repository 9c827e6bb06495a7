//! The state of processes and networks under the faults of a schedule.

use std::time::Duration;

use pliant_stream::emulator::{LinkConfig, Loss};

use super::schedule::Random;
use super::{FaultKind, HEALED, LOOK, SimulatedFault};
use crate::pair::Stalled;

/// A fault that has begun.
#[derive(Debug)]
struct Begun {
    fault: SimulatedFault,
    until: Duration,
    /// It has changed something.
    took: bool,
}

/// Which process suffers what, and until when.
#[derive(Debug, Default)]
pub(super) struct Processes {
    begun: Vec<Begun>,
    /// The apps that wait for a slow disk, and until when.
    writing: Vec<(usize, Duration)>,
}

impl Processes {
    pub(super) fn begin(&mut self, fault: SimulatedFault) {
        let until = (fault.at + fault.lasts).min(HEALED);
        self.begun.push(Begun { fault, until, took: false });
    }

    /// The app of a process writes a file. Where its disk is slow, it waits for that for two
    /// seconds at most.
    pub(super) fn write(&mut self, process: usize, now: Duration) {
        if self.is(process, FaultKind::SlowDisk, now) {
            self.take(process, &[FaultKind::SlowDisk], now);
            self.writing.push((process, now + Duration::from_secs(2)));
        }
    }

    /// Notes that the faults of some kinds that a process suffers now have changed something.
    pub(super) fn take(&mut self, process: usize, kinds: &[FaultKind], now: Duration) {
        for begun in &mut self.begun {
            let suffers = begun.fault.process == process && now < begun.until;
            begun.took |= suffers && kinds.contains(&begun.fault.kind);
        }
    }

    /// Notes that the fault that began last has changed something.
    pub(super) fn take_last(&mut self) {
        self.begun.last_mut().into_iter().for_each(|begun| begun.took = true);
    }

    /// The kinds of the faults that have changed something.
    pub(super) fn took(&self) -> Vec<FaultKind> {
        self.begun.iter().filter(|begun| begun.took).map(|begun| begun.fault.kind).collect()
    }

    fn is(&self, process: usize, kind: FaultKind, now: Duration) -> bool {
        let mut all = self.begun.iter().filter(|begun| begun.fault.kind == kind);
        all.any(|begun| begun.fault.process == process && now < begun.until)
    }

    pub(super) fn is_down(&self, process: usize, now: Duration) -> bool {
        self.is(process, FaultKind::Crash, now)
    }

    /// Whether all threads of a process stand still. One that is starved gets one look in eight to
    /// forty.
    fn is_stalled(&self, process: usize, now: Duration) -> bool {
        let look = (now.as_micros() / LOOK.as_micros()) as usize;
        let starved = self.is(process, FaultKind::Starvation, now);
        self.is(process, FaultKind::Stall, now) || (starved && !look.is_multiple_of(8 * (1 + process)))
    }

    /// The threads of frames and network that stand still, all of the process or one.
    pub(super) fn stalled(&self, process: usize, now: Duration) -> Stalled {
        let all = self.is_stalled(process, now);
        let waits = self.writing.iter().any(|(other, until)| *other == process && now < *until)
            && self.is(process, FaultKind::SlowDisk, now);
        let app = all || waits || self.is(process, FaultKind::AppStall, now);
        Stalled { app, network: all || self.is(process, FaultKind::NetworkStall, now) }
    }

    /// The same, of a process with something to do: its faults have changed something.
    pub(super) fn take_stalls(&mut self, process: usize, now: Duration) -> Stalled {
        use FaultKind::{AppStall, NetworkStall, Stall, Starvation};
        let stalled = self.stalled(process, now);
        if self.is_stalled(process, now) {
            self.take(process, &[Stall, Starvation], now);
        }
        self.take(process, &[AppStall, NetworkStall], now);
        stalled
    }

    /// Whether the thread of a process's device stands still, and whether its device is gone.
    pub(super) fn take_device(&mut self, process: usize, now: Duration) -> [bool; 2] {
        use FaultKind::{DeviceLost, DeviceStall};
        self.take(process, &[DeviceStall, DeviceLost], now);
        let stalled = self.is_stalled(process, now) || self.is(process, DeviceStall, now);
        [stalled, self.is(process, DeviceLost, now)]
    }

    pub(super) fn is_partitioned(&self, process: usize, now: Duration) -> bool {
        self.is(process, FaultKind::Partition, now)
    }

    pub(super) fn is_disturbed(&self, process: usize, now: Duration) -> bool {
        self.is(process, FaultKind::BadNetwork, now)
    }

    /// What the malicious member does: the attack that began last.
    pub(super) fn attack(&self, now: Duration) -> Option<FaultKind> {
        let last = self.begun.iter().rev().find(|begun| begun.fault.kind.is_attack());
        last.filter(|begun| now < begun.until).map(|begun| begun.fault.kind)
    }
}

/// An ordinary network.
pub(super) fn network(random: &mut Random) -> LinkConfig {
    LinkConfig {
        delay: Duration::from_millis(random.range(5, 80)),
        jitter: Duration::from_millis(random.range(0, 6)),
        loss: Loss::Random(0.01 * random.range(0, 5) as f64),
        ..LinkConfig::default()
    }
}

/// The same network on a bad day.
pub(super) fn disturbed(link: &LinkConfig) -> LinkConfig {
    let by = Duration::from_millis(60);
    LinkConfig { loss: Loss::Random(0.33), duplicate: 0.2, reorder: 0.2, reorder_by: by, ..link.clone() }
}
