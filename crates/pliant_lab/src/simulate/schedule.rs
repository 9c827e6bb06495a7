//! What goes wrong in a session, and when: drawn from the seed.

use std::fmt;
use std::time::Duration;

const MS: Duration = Duration::from_millis(1);

/// Random numbers by xorshift (Marsaglia 2003). Equal seeds give equal numbers.
#[derive(Debug, Clone)]
pub(super) struct Random(u64);

impl Random {
    pub(super) fn new(seed: u64) -> Self {
        // A multiplication spreads neighboring seeds; xorshift itself needs a state other than 0.
        Self(seed.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    pub(super) fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 >> 8
    }

    /// A number from `from` to `to - 1`.
    pub(super) fn range(&mut self, from: u64, to: u64) -> u64 {
        from + self.next() % to.saturating_sub(from).max(1)
    }

    pub(super) fn index(&mut self, count: usize) -> usize {
        self.range(0, count as u64) as usize
    }

    fn millis(&mut self, from: u64, to: u64) -> Duration {
        MS * u32::try_from(self.range(from, to)).unwrap_or(0)
    }
}

/// Kinds of faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum FaultKind {
    /// The process is killed and started again after a while.
    Crash,
    /// The process stands still.
    Stall,
    /// The process gets the processor for 5 ms of every 40 to 200 ms.
    Starvation,
    /// Nothing passes between the process and the others.
    Partition,
    /// The clock of the process jumps ahead.
    ClockJump,
    /// The network loses a third of the datagrams, and repeats and reorders others.
    BadNetwork,
    /// The process connects anew before the end of its old connection is noticed.
    SecondConnection,
    /// A member of the session sends bytes without meaning, and altered messages.
    Garbage,
    /// A member of the session repeats what it has sent before, in another order.
    Replay,
    /// A member of the session sends thousands of datagrams and grabs a second.
    Flood,
    /// The thread of the app's frames stands still. The network's thread and the device's loop go
    /// on.
    AppStall,
    /// The network's thread stands still. Frames and the device's loop go on.
    NetworkStall,
    /// The thread of the device's loop stands still, and its motors hold the last force.
    DeviceStall,
    /// The device is unplugged and plugged in again.
    DeviceLost,
    /// The disk answers late. Who writes a file within a frame, as an app does that keeps the
    /// numbers of users or a model when somebody comes, loses the frames until it does.
    SlowDisk,
    /// The process tries to connect over a slow path, gives that up and connects anew. What belongs
    /// to the old attempt arrives after the new one.
    LateReconnect,
}

impl FaultKind {
    /// All kinds.
    pub const ALL: [Self; 16] = [
        Self::Crash,
        Self::Stall,
        Self::Starvation,
        Self::Partition,
        Self::ClockJump,
        Self::BadNetwork,
        Self::SecondConnection,
        Self::Garbage,
        Self::Replay,
        Self::Flood,
        Self::AppStall,
        Self::NetworkStall,
        Self::DeviceStall,
        Self::DeviceLost,
        Self::SlowDisk,
        Self::LateReconnect,
    ];

    /// Those of whole processes, of networks and of malicious members.
    pub const PROCESSES: &'static [Self] = Self::ALL.split_at(10).0;

    /// The name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Crash => "crash",
            Self::Stall => "stall",
            Self::Starvation => "starvation",
            Self::Partition => "partition",
            Self::ClockJump => "clock jump",
            Self::BadNetwork => "bad network",
            Self::SecondConnection => "second connection",
            Self::Garbage => "garbage",
            Self::Replay => "replay",
            Self::Flood => "flood",
            Self::AppStall => "stall of the app",
            Self::NetworkStall => "stall of the network",
            Self::DeviceStall => "stall of the device",
            Self::DeviceLost => "device lost",
            Self::SlowDisk => "slow disk",
            Self::LateReconnect => "late reconnect",
        }
    }

    /// Returns whether only the malicious member does this.
    pub(super) fn is_attack(self) -> bool {
        matches!(self, Self::Garbage | Self::Replay | Self::Flood)
    }
}

/// One fault of a schedule.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SimulatedFault {
    /// When it begins.
    pub at: Duration,
    /// What happens.
    pub kind: FaultKind,
    /// Whom it happens to. At a host with guests, 0 is the host. The last one is malicious.
    pub process: usize,
    /// How long it lasts. For a jump of the clock, how far.
    pub lasts: Duration,
}

impl fmt::Display for SimulatedFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (at, lasts) = (self.at.as_secs_f64(), self.lasts.as_secs_f64());
        write!(f, "{at:7.3} s  {:<20}  process {}  {lasts:.3} s", self.kind.name(), self.process)
    }
}

/// Draws the faults of a session, of some kinds, in order of time. They begin between `from` and
/// `to`, and the last of `processes` is malicious.
pub(super) fn schedule(
    random: &mut Random,
    kinds: &[FaultKind],
    processes: usize,
    [from, to]: [Duration; 2],
) -> Vec<SimulatedFault> {
    let span = u64::try_from((to.saturating_sub(from)).as_millis()).unwrap_or(1);
    let mut faults: Vec<SimulatedFault> = (0..random.range(4, 13))
        .map(|_| {
            let at = from + random.millis(0, span);
            let kind = kinds[random.index(kinds.len())];
            let process = if kind.is_attack() { processes - 1 } else { random.index(processes - 1) };
            let lasts = match kind {
                FaultKind::Crash => random.millis(100, 5000),
                FaultKind::Stall | FaultKind::AppStall | FaultKind::NetworkStall | FaultKind::DeviceStall => {
                    random.millis(10, 2000)
                }
                FaultKind::ClockJump => random.millis(1, 5000),
                FaultKind::SecondConnection => Duration::ZERO,
                FaultKind::Starvation | FaultKind::BadNetwork => random.millis(300, 3000),
                FaultKind::Partition | FaultKind::SlowDisk => random.millis(50, 6000),
                FaultKind::DeviceLost | FaultKind::LateReconnect => random.millis(200, 3000),
                FaultKind::Garbage | FaultKind::Replay | FaultKind::Flood => random.millis(100, 3000),
            };
            SimulatedFault { at, kind, process, lasts }
        })
        .collect();
    faults.sort_by_key(|fault| fault.at);
    faults
}
