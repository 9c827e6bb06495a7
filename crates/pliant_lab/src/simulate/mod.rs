//! Whole sessions under faults, in virtual time: who crashes, stalls, is partitioned or lies, and
//! when, follows from a seed, and so does all else.
//!
//! The even seeds are a host with guests, the odd ones a mesh of peers. The last of them is
//! malicious. The others hold the body with a simulated device, whose loop has a thread of its own
//! as the app and the network have. What must hold is checked in every tick and in every period of
//! a device, and once more a while after the last fault.
//!
//! Of files, the sessions of `pliant_net` write recordings only, on a thread of their own, whose
//! bounded queue no frame waits for. An app writes the numbers of users and the models that came:
//! these are what a slow disk delays here.

mod attack;
mod device;
mod mesh;
mod schedule;
mod star;
mod state;

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use pliant_bake::{Anchor, BakeConfig, Comparison, bake};
use pliant_mesh::shapes;
use pliant_modal::{Damping, Element, GrabConfig, ModalModel};
use serde::Serialize;

pub use schedule::{FaultKind, SimulatedFault};

use crate::{LabError, Progress};

/// When the faults may begin: everybody is there by the first, and the last one is over some
/// seconds after the second.
const FAULTS: [Duration; 2] = [Duration::from_secs(4), Duration::from_secs(16)];
/// Until when faults may last.
const HEALED: Duration = Duration::from_secs(22);
/// The end. Who was lost has been noticed, has come back and sees what all see.
const END: Duration = Duration::from_secs(40);
/// Silence after which a connection counts as gone. Shorter than by default, so that partitions and
/// clock jumps exceed it.
const IDLE: Duration = Duration::from_secs(3);
/// Time between two looks at what is due.
const LOOK: Duration = Duration::from_millis(5);
/// The spring of an honest hand, N/m.
const SPRING: f64 = 50.0;
/// Largest force that may be displayed to an honest hand, N. It is the limit of a guest's hands by
/// default.
const MAX_FORCE: f64 = 1000.0;
/// Largest difference after the end of all faults, as a share of the largest shape.
const AGREES: f64 = 0.02;
/// Looks of the last second at which somebody's state has to be comparable with another's.
const COMPARED: u32 = 100;
/// Largest memory of a session at any time, and at its end, bytes. What is in flight counts too,
/// and the ends of former connections, which the laboratory keeps: a thousand seeds had 10 MB at
/// most.
const MAX_MEMORY: [i64; 2] = [24 << 20, 16 << 20];

/// What to simulate.
#[derive(Debug, Clone, Copy)]
pub struct SimulateSettings {
    /// The first seed.
    pub from: u64,
    /// Number of seeds.
    pub seeds: u64,
    /// The kinds of faults that are drawn. Other kinds make other sessions of the same seeds.
    pub kinds: &'static [FaultKind],
    /// Returns the memory that this thread has allocated and not freed, bytes. With it, the memory
    /// of each session is bounded. Default: none.
    pub memory: Option<fn() -> i64>,
}

/// A seed whose session broke what must hold.
#[derive(Debug, Clone, Serialize)]
pub struct Failure {
    /// The seed, which gives the same session again.
    pub seed: u64,
    /// What did not hold, and when.
    pub what: String,
    /// The faults of the session, one a line.
    pub schedule: Vec<String>,
}

/// What was simulated.
#[derive(Debug, Clone, Default, Serialize)]
pub struct SimulateReport {
    /// Number of sessions.
    pub seeds: u64,
    /// Ticks of all hosts and peers.
    pub ticks: u64,
    /// Virtual time of all sessions, s.
    pub virtual_seconds: f64,
    /// Number of faults by kind that have changed something: nobody is stalled who is not there.
    pub faults: BTreeMap<&'static str, u64>,
    /// Number of faults that were drawn.
    pub drawn: u64,
    /// A digest of the shapes and reactions of all sessions. Equal seeds give equal digests.
    pub digest: u64,
    /// Largest memory of a session at any time, and at its end, bytes; 0 where it is not measured.
    pub largest_memory: [i64; 2],
    /// Largest reaction that was displayed to a guest's hand, over the largest true one of its
    /// session.
    pub largest_share: f64,
    /// Periods of all loops of devices.
    pub device_periods: u64,
    /// Largest force of a device, N, and the largest rise of a force in a period over the slew
    /// limit of its device.
    pub largest_force: f64,
    /// See [`largest_force`](Self::largest_force).
    pub largest_rise: f64,
    /// What broke.
    pub failures: Vec<Failure>,
    /// Running time, s.
    pub seconds: f64,
}

/// What one session gives.
#[derive(Debug)]
struct Outcome {
    ticks: u64,
    share: f64,
    device_record: device::DeviceRecord,
    took: Vec<FaultKind>,
    digest: Digest,
    memory: [i64; 2],
}

/// A digest of numbers in their order (FNV-1a over their bits).
#[derive(Debug, Clone, Copy)]
struct Digest(u64);

impl Digest {
    const EMPTY: Self = Self(0xCBF2_9CE4_8422_2325);

    fn add(&mut self, bits: u64) {
        for byte in bits.to_le_bytes() {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3);
        }
    }

    fn add_all(&mut self, values: &[f64]) {
        values.iter().for_each(|value| self.add(value.to_bits()));
    }
}

/// The memory of one session, which runs on one thread.
#[derive(Debug, Clone, Copy)]
struct Memory {
    probe: Option<fn() -> i64>,
    before: i64,
    largest: i64,
}

impl Memory {
    fn new(probe: Option<fn() -> i64>) -> Self {
        Self { probe, before: probe.map_or(0, |probe| probe()), largest: 0 }
    }

    /// Returns the memory that the session has now, bytes.
    fn look(&mut self) -> i64 {
        let now = self.probe.map_or(0, |probe| probe() - self.before);
        self.largest = self.largest.max(now);
        now
    }
}

/// Simulates the sessions of some seeds, on all cores.
///
/// # Errors
/// Returns [`LabError::Bake`] when the body cannot be made. What breaks in a session is in the
/// report.
pub fn simulate(
    settings: &SimulateSettings,
    progress: &mut dyn Progress,
) -> Result<SimulateReport, LabError> {
    use rayon::prelude::*;
    let began = Instant::now();
    let model = body()?;
    let mut report = SimulateReport { seeds: settings.seeds, ..SimulateReport::default() };
    let mut digest = Digest::EMPTY;
    let mut device_record = device::DeviceRecord::default();
    // In chunks, so that progress can be reported.
    let end = settings.from.saturating_add(settings.seeds);
    let mut next = settings.from;
    while next < end {
        let until = next.saturating_add(64).min(end);
        let all = (next..until).into_par_iter().map(|seed| (seed, session(seed, &model, settings)));
        let done: Vec<_> = all.collect();
        for (seed, (faults, outcome)) in done {
            report.virtual_seconds += END.as_secs_f64();
            report.drawn += faults.len() as u64;
            match outcome {
                Ok(outcome) => {
                    for kind in &outcome.took {
                        *report.faults.entry(kind.name()).or_default() += 1;
                    }
                    digest.add(outcome.digest.0);
                    for (largest, memory) in report.largest_memory.iter_mut().zip(outcome.memory) {
                        *largest = memory.max(*largest);
                    }
                    report.ticks += outcome.ticks;
                    device_record.add(outcome.device_record);
                    report.largest_share = report.largest_share.max(outcome.share);
                }
                Err(what) => {
                    let schedule = faults.iter().map(ToString::to_string).collect();
                    report.failures.push(Failure { seed, what, schedule });
                }
            }
        }
        next = until;
        progress.report("simulate", (next - settings.from) as f64 / settings.seeds.max(1) as f64);
    }
    report.seconds = began.elapsed().as_secs_f64();
    report.digest = digest.0;
    report.device_periods = device_record.periods;
    (report.largest_force, report.largest_rise) = (device_record.force, device_record.rise);
    Ok(report)
}

/// The session of a seed.
fn session(
    seed: u64,
    model: &Arc<ModalModel>,
    settings: &SimulateSettings,
) -> (Vec<SimulatedFault>, Result<Outcome, String>) {
    let mut random = schedule::Random::new(seed);
    let processes = 3 + random.index(2);
    let faults = schedule::schedule(&mut random, settings.kinds, processes, FAULTS);
    let memory = Memory::new(settings.memory);
    let run = || match seed % 2 {
        0 => star::run(model, seed, processes, &faults, (random.clone(), memory)),
        _ => mesh::run(model, seed, processes, &faults, (random.clone(), memory)),
    };
    let outcome = catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no text");
        Err(format!("a panic: {text}"))
    });
    (faults, outcome)
}

/// A bar of a meter that is held at one end.
fn body() -> Result<Arc<ModalModel>, LabError> {
    let config = BakeConfig {
        element: Element::Tet4,
        modes: 10,
        young: 1e5,
        poisson: 0.3,
        density: 100.0,
        damping: Damping::Ratio(0.05),
        anchors: vec![Anchor { axis: 0, comparison: Comparison::Less, bound: 1e-9 }],
        ..BakeConfig::linear()
    };
    Ok(Arc::new(bake(&shapes::bar([8, 2, 2], [1.0, 0.2, 0.2])?, None, &config, &mut |_, _| ())?.model))
}

/// The surface vertex that a process holds, and where its hand is at a time: on a circle of 8 cm
/// beside the vertex.
fn hand(model: &ModalModel, process: usize, now: Duration) -> (u32, [f64; 3]) {
    let positions = model.surface().positions();
    let at = 1.0 - 0.2 * process as f32;
    let away = |p: &[f32; 3]| (p[0] - at).powi(2) + (p[1] - 0.2).powi(2) + (p[2] - 0.2).powi(2);
    let vertex = (0..positions.len()).min_by(|a, b| away(&positions[*a]).total_cmp(&away(&positions[*b])));
    let vertex = vertex.unwrap_or(0);
    let [x, y, z] = positions[vertex].map(f64::from);
    let angle = (1.0 + 0.3 * process as f64) * now.as_secs_f64();
    let target = [x, y + 0.08 * angle.sin(), z + 0.08 * (1.0 - angle.cos())];
    (u32::try_from(vertex).unwrap_or(0), target)
}

/// How honest hands hold.
fn hold() -> GrabConfig {
    GrabConfig { stiffness: Some(SPRING), ..GrabConfig::default() }
}

fn norm(x: [f64; 3]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Distance of two sets of modal coordinates.
fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}
