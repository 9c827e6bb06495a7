//! The kinds of datagram between host and guest, and between peers.

use super::{Inputs, Reader, RigidPoses, TickFrame, Writer};
use crate::StreamError;
use crate::state::{BodyId, Tick};

const FRAME: u8 = 1;
const TARGETS: u8 = 2;
const NACK: u8 = 3;
const PING: u8 = 4;
const PONG: u8 = 5;
const INPUTS: u8 = 6;
const INPUT_REQUEST: u8 = 7;
const RIGIDS: u8 = 8;

/// Largest number of runs in one NACK or input request.
pub(crate) const MAX_NACK_RUNS: usize = 32;
/// Largest number of target entries in one datagram.
pub(crate) const MAX_TARGETS: usize = 64;
/// Largest length of one run, ticks.
pub(crate) const MAX_NACK_RUN: u8 = 64;

/// A run of missing ticks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NackRun {
    /// The first missing tick.
    pub first: Tick,
    /// Number of ticks in the run, 1..=64.
    pub count: u8,
}

/// Ticks of one body that a guest requests again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Nack {
    /// The body.
    pub body: BodyId,
    /// The runs, at most 32.
    pub runs: Vec<NackRun>,
}

/// Target of one hand of a guest at one of the guest's input counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetEntry {
    /// The guest's number for the grab.
    pub grab: u16,
    /// The guest's input counter, which ascends by one for each `set_target` call.
    pub input: u32,
    /// Position of the hand, world, m.
    pub target: [f64; 3],
}

/// Targets of a guest's grabs: the newest and the two before it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Targets {
    /// The targets, at most 64.
    pub entries: Vec<TargetEntry>,
}

/// Counts of what one side received, from which the other side computes its outgoing loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ReceiverReport {
    /// Datagrams received since the session began (low 32 bits).
    pub received: u32,
    /// Number of datagrams up to the highest sequence number seen (low 32 bits).
    pub highest: u32,
}

/// Clock exchange with four timestamps, as of NTP: `t1` guest sends, `t2` host receives at the
/// earliest, `t3` host processes and sends, `t4` guest receives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Clock {
    /// Guest's clock when the guest sends, us.
    pub t1: u64,
    /// Host's clock when the host received at the earliest, us.
    pub t2: u64,
    /// Host's clock when the host sends, us.
    pub t3: u64,
    /// Report on what the sender of this datagram has received.
    pub report: ReceiverReport,
    /// The round trip that the guest has measured since its last request, us; 0 if none.
    pub round_trip: u32,
}

/// All unreliable traffic of a session. The sequence number counts all datagrams from this sender
/// to this receiver.
#[derive(Debug, Clone, PartialEq)]
pub enum Datagram {
    /// Host to guest: a tick of a body.
    Frame(TickFrame),
    /// Guest to host: targets of the guest's hands.
    Targets(Targets),
    /// Guest to host: ticks to send again.
    Nack(Nack),
    /// Guest to host: clock request with `t1`, and the guest's report.
    Ping(Clock),
    /// Host to guest: clock answer, and the host's report.
    Pong(Clock),
    /// Peer to peer: the inputs of the sender's hands.
    Inputs(Inputs),
    /// Peer to peer: runs of the receiver's inputs that the sender lacks, at most 32.
    InputRequest(Vec<NackRun>),
    /// Host to guest: rigid bodies that move.
    Rigids(RigidPoses),
}

impl Datagram {
    /// Header of every datagram: kind and sequence number, 3 bytes.
    pub(crate) fn header(kind: u8, sequence: u16) -> [u8; 3] {
        let [a, b] = sequence.to_le_bytes();
        [kind, a, b]
    }

    /// Puts a header before the bytes of a frame that was encoded once for all peers.
    pub(crate) fn wrap_frame(sequence: u16, body: &[u8]) -> Vec<u8> {
        let mut out = Vec::with_capacity(body.len() + 3);
        out.extend_from_slice(&Self::header(FRAME, sequence));
        out.extend_from_slice(body);
        out
    }

    /// Encodes this datagram.
    pub fn encode(&self, sequence: u16) -> Vec<u8> {
        let mut w = Writer::with_capacity(64);
        match self {
            Self::Frame(frame) => {
                w.raw(&Self::header(FRAME, sequence));
                frame.encode(&mut w);
            }
            Self::Targets(targets) => {
                w.raw(&Self::header(TARGETS, sequence));
                let entries = &targets.entries[..targets.entries.len().min(MAX_TARGETS)];
                w.u8(entries.len() as u8);
                for e in entries {
                    w.u16(e.grab);
                    w.u32(e.input);
                    w.vector(e.target);
                }
            }
            Self::Nack(nack) => {
                w.raw(&Self::header(NACK, sequence));
                w.u16(nack.body.0);
                encode_runs(&nack.runs, &mut w);
            }
            Self::Ping(clock) => {
                w.raw(&Self::header(PING, sequence));
                w.u64(clock.t1);
                w.u32(clock.report.received);
                w.u32(clock.report.highest);
                w.u32(clock.round_trip);
            }
            Self::Pong(clock) => {
                w.raw(&Self::header(PONG, sequence));
                w.u64(clock.t1);
                w.u64(clock.t2);
                w.u64(clock.t3);
                w.u32(clock.report.received);
                w.u32(clock.report.highest);
            }
            Self::Inputs(inputs) => {
                w.raw(&Self::header(INPUTS, sequence));
                inputs.encode(&mut w);
            }
            Self::InputRequest(runs) => {
                w.raw(&Self::header(INPUT_REQUEST, sequence));
                encode_runs(runs, &mut w);
            }
            Self::Rigids(rigids) => {
                w.raw(&Self::header(RIGIDS, sequence));
                rigids.encode(&mut w);
            }
        }
        w.into_bytes()
    }

    /// Decodes arbitrary bytes into the sequence number and the datagram.
    ///
    /// # Errors
    /// Returns [`StreamError::Truncated`], [`StreamError::Invalid`] or [`StreamError::NotFinite`],
    /// with the name of the field.
    pub fn decode(bytes: &[u8]) -> Result<(u16, Self), StreamError> {
        let mut r = Reader::new(bytes);
        let kind = r.u8("datagram kind")?;
        let sequence = r.u16("sequence")?;
        let datagram = match kind {
            FRAME => Self::Frame(TickFrame::decode(&mut r)?),
            TARGETS => {
                let count = r.u8("target count")?;
                bounded("target count", count, MAX_TARGETS, "at most 64")?;
                let mut entries = Vec::with_capacity(usize::from(count).min(r.left() / 18));
                for _ in 0..count {
                    entries.push(TargetEntry {
                        grab: r.u16("target grab")?,
                        input: r.u32("target input")?,
                        target: r.vector("target")?,
                    });
                }
                Self::Targets(Targets { entries })
            }
            NACK => {
                let body = BodyId(r.u16("nack body")?);
                Self::Nack(Nack { body, runs: decode_runs(&mut r)? })
            }
            PING => {
                let t1 = r.u64("t1")?;
                let report = report(&mut r)?;
                Self::Ping(Clock { t1, report, round_trip: r.u32("round trip")?, ..Clock::default() })
            }
            PONG => {
                let (t1, t2, t3) = (r.u64("t1")?, r.u64("t2")?, r.u64("t3")?);
                Self::Pong(Clock { t1, t2, t3, report: report(&mut r)?, round_trip: 0 })
            }
            INPUTS => Self::Inputs(Inputs::decode(&mut r)?),
            INPUT_REQUEST => Self::InputRequest(decode_runs(&mut r)?),
            RIGIDS => Self::Rigids(RigidPoses::decode(&mut r)?),
            other => {
                return Err(StreamError::Invalid {
                    what: "datagram kind",
                    found: other.to_string(),
                    expected: "1..=8",
                });
            }
        };
        r.finish("datagram")?;
        Ok((sequence, datagram))
    }
}

fn report(r: &mut Reader<'_>) -> Result<ReceiverReport, StreamError> {
    Ok(ReceiverReport { received: r.u32("report received")?, highest: r.u32("report highest")? })
}

fn encode_runs(runs: &[NackRun], w: &mut Writer) {
    let runs = &runs[..runs.len().min(MAX_NACK_RUNS)];
    w.u8(runs.len() as u8);
    for run in runs {
        w.tick(run.first);
        w.u8(run.count);
    }
}

fn decode_runs(r: &mut Reader<'_>) -> Result<Vec<NackRun>, StreamError> {
    let count = r.u8("runs")?;
    bounded("runs", count, MAX_NACK_RUNS, "at most 32")?;
    let mut runs = Vec::with_capacity(usize::from(count).min(r.left() / 7));
    for _ in 0..count {
        let first = r.tick("run tick")?;
        let count = r.u8("run length")?;
        if count == 0 || count > MAX_NACK_RUN {
            let found = count.to_string();
            return Err(StreamError::Invalid { what: "run length", found, expected: "1..=64" });
        }
        runs.push(NackRun { first, count });
    }
    Ok(runs)
}

/// Checks a count or flag.
pub(super) fn bounded(
    what: &'static str,
    found: u8,
    limit: usize,
    expected: &'static str,
) -> Result<(), StreamError> {
    if usize::from(found) <= limit {
        Ok(())
    } else {
        Err(StreamError::Invalid { what, found: found.to_string(), expected })
    }
}
