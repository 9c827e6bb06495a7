//! The state of processes and networks under the faults of a schedule.

use std::time::Duration;

use pliant_stream::emulator::{LinkConfig, Loss};

use super::schedule::Random;
use super::{Fault, FaultKind, HEALED, LOOK};

#[derive(Debug, Clone, Default)]
struct Process {
    down: Duration,
    stalled: Duration,
    starved: Duration,
    parted: Duration,
    disturbed: Duration,
}

/// Until when each process suffers what.
#[derive(Debug)]
pub(super) struct Processes {
    all: Vec<Process>,
    attack: Option<(FaultKind, Duration)>,
}

impl Processes {
    pub(super) fn new(count: usize) -> Self {
        Self { all: vec![Process::default(); count], attack: None }
    }

    pub(super) fn begin(&mut self, fault: Fault) {
        let until = (fault.at + fault.lasts).min(HEALED);
        let Some(process) = self.all.get_mut(fault.process) else { return };
        let lasts = match fault.kind {
            FaultKind::Crash => &mut process.down,
            FaultKind::Stall => &mut process.stalled,
            FaultKind::Starvation => &mut process.starved,
            FaultKind::Partition => &mut process.parted,
            FaultKind::BadNetwork => &mut process.disturbed,
            FaultKind::ClockJump | FaultKind::SecondConnection => return,
            FaultKind::Garbage | FaultKind::Replay | FaultKind::Flood => {
                self.attack = Some((fault.kind, until));
                return;
            }
        };
        *lasts = until.max(*lasts);
    }

    fn of(&self, process: usize, until: fn(&Process) -> Duration, now: Duration) -> bool {
        self.all.get(process).is_some_and(|process| now < until(process))
    }

    pub(super) fn is_down(&self, process: usize, now: Duration) -> bool {
        self.of(process, |p| p.down, now)
    }

    /// A process that is starved gets one look in eight to forty.
    pub(super) fn is_stalled(&self, process: usize, now: Duration) -> bool {
        let look = (now.as_micros() / LOOK.as_micros()) as usize;
        let starved = self.of(process, |p| p.starved, now) && !look.is_multiple_of(8 * (1 + process));
        starved || self.of(process, |p| p.stalled, now)
    }

    pub(super) fn is_parted(&self, process: usize, now: Duration) -> bool {
        self.of(process, |p| p.parted, now)
    }

    pub(super) fn is_disturbed(&self, process: usize, now: Duration) -> bool {
        self.of(process, |p| p.disturbed, now)
    }

    pub(super) fn attack(&self, now: Duration) -> Option<FaultKind> {
        self.attack.filter(|(_, until)| now < *until).map(|(kind, _)| kind)
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
