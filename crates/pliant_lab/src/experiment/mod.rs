//! Measures streaming: one body, scripted hands, an emulated path, and metrics of the guest's
//! visual state.
//!
//! Everything runs in virtual time. Ten minutes of a session take seconds, and the same seed gives
//! the same metrics and the same hash.

mod peers;
mod run;
mod shape_error;

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{Body, BodyConfig, Elasticity, Integrator, ModalModel, Relaxation, StepSettings};
use pliant_stream::emulator::LinkConfig;
use pliant_stream::peer::PeerSessionConfig;
use pliant_stream::{
    BodyId, GuestSessionConfig, HostSessionConfig, Newmark, PeerId, Policy, RecoveryConfig, RepairCounts,
    StreamError,
};

use crate::pair::{Pair, PathConfig};
use run::Run;

/// Visual error above which a body counts as not recovered, as a share of the largest displacement.
const RECOVERED: f64 = 0.005;

/// Settings of a measurement.
#[derive(Debug, Clone)]
pub struct Experiment {
    /// The body.
    pub model: Arc<ModalModel>,
    /// The guest's loss recovery.
    pub recovery: RecoveryConfig,
    /// The path from host to guest, which carries frames.
    pub down: LinkConfig,
    /// The path from guest to host, which carries NACKs and targets.
    pub up: LinkConfig,
    /// Steps a second. Default: 40.
    pub rate: f64,
    /// Measured time after the guest has joined, s. Default: 30.
    pub seconds: f64,
    /// Seed of the links. Default: [`Experiment::SEED`].
    pub seed: u64,
    /// Number of streamed modes. Default: all.
    pub modes: Option<u16>,
    /// How the body resists deformation. Default: linear.
    pub elasticity: Elasticity,
    /// A body with reduced elasticity has the own shapes of the patches that are held
    /// ([`HeldShapes`](pliant_modal::HeldShapes)): at the host, at a guest that holds it, and
    /// between peers. They are made at once, without time in the session. Default: false.
    pub held_shapes: bool,
    /// The host's integrator. Default: [`RecoveryConfig::integrator`].
    pub integrator: Integrator,
    /// Relaxation of the material. Default: none, elastic.
    pub relaxation: Option<Relaxation>,
    /// The filter of acceleration streams. Its `h` is taken from `rate`. Default: beta 4/9, gamma
    /// 5/6.
    pub newmark: Newmark,
    /// Delay before the host answers a NACK. Default: none.
    pub resend_after: Duration,
    /// Time for which the body moves before the down path gets its loss and jitter. Scheduled
    /// losses count from the end of this time. Default: 2 s.
    pub warmup: Duration,
    /// The scripted hands. Default: [`Experiment::default_hands`].
    pub hands: Vec<HandScript>,
    /// See [`HostSessionConfig::quantum`]. Default: 2^-14.
    pub quantum: f64,
    /// Clock for the time that decoding, correcting and stepping take. `None` leaves
    /// [`Metrics::cpu_us_per_tick`] at 0.
    pub cpu_clock: Option<fn() -> Duration>,
    /// Earlier ticks that each datagram between peers repeats. Default: that of
    /// [`PeerSessionConfig`].
    pub peer_repeats: usize,
    /// Ticks over which a peer blends a correction. Default: that of [`PeerSessionConfig`].
    pub peer_blend_ticks: u16,
    /// The guest also holds the body, where the first hand does, and sends its target every tick.
    /// This measures the traffic from guest to host. The host does not act on the hand, so the
    /// errors are meaningless then. Default: false.
    pub guest_hand: bool,
    /// Keep the visual and true displacement and reaction of the first hand per tick, for plots.
    /// Default: false.
    pub keep_track: bool,
}

/// A scripted hand. It circles about the start of its grab on a smooth path that never repeats,
/// with a small tremor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandScript {
    /// Center of the patch.
    pub vertex: u32,
    /// Radius of the patch, m.
    pub radius: f64,
    /// Largest distance from the start along each axis, m.
    pub reach: [f64; 3],
    /// Lowest frequency, Hz. The path adds two more at 1.618 and 2.414 times this frequency.
    pub frequency: f64,
    /// Amplitude of the tremor, m: 9.3 and 11.7 Hz on top of the path.
    pub tremor: f64,
    /// Start and end of the grab, s since the start. `None` means all the time.
    pub holds: Option<(f64, f64)>,
}

impl HandScript {
    /// Displacement of the hand from the start of its grab, m, `t` seconds after it.
    pub fn path(&self, t: f64) -> [f64; 3] {
        let w = std::f64::consts::TAU * self.frequency * t;
        // The ramp starts from rest and is smooth.
        let ramp = 1.0 - (-(t * 2.0).powi(2)).exp();
        let wave = |phase: f64| {
            (0.5 * (w + phase).sin() + 0.3 * (1.618 * w + 2.0 * phase).sin() + 0.2 * (2.414 * w).sin()) * ramp
        };
        let shake = |phase: f64| {
            let turn = std::f64::consts::TAU * t;
            self.tremor * ramp * (0.6 * (9.3 * turn + phase).sin() + 0.4 * (11.7 * turn + 2.0 * phase).sin())
        };
        let [x, y, z] = self.reach;
        [x * wave(0.0) + shake(0.0), y * wave(1.1) + shake(1.1), z * wave(2.3) + shake(2.3)]
    }
}

/// Results of a run. Percentages are relative to the largest true displacement, or for reactions to
/// the largest true reaction. The displacement of a free body is that from where its model places
/// it at rest, with its pose.
#[derive(Debug, Clone, PartialEq, Default, serde::Serialize)]
pub struct Metrics {
    /// Ticks that the guest showed.
    pub ticks: u64,
    /// Ticks that were not shown in time, because the visual state stood still or skipped them. In
    /// the errors, each of these ticks compares the last visual state with the true state of that
    /// tick, and the last visual reactions with the true ones.
    pub missing: u64,
    /// Frames that the path lost.
    pub lost: u64,
    /// Ticks that were stepped with a prediction.
    pub guessed: u64,
    /// Predicted ticks that were corrected later.
    pub recovered: u64,
    /// Visual error, root mean square over all ticks (including missing ones) and compared
    /// vertices.
    pub rms_percent: f64,
    /// Visual error, root mean square, as a share of the root mean square of the true displacement
    /// over the same ticks and vertices. A slow or short motion does not make it look small.
    pub rms_of_motion_percent: f64,
    /// Largest visual error.
    pub max_percent: f64,
    /// Visual error at the last tick, shown or missing.
    pub end_percent: f64,
    /// Error of the confirmed state at the last tick. Of a free body, the modal coordinates are the
    /// confirmed ones, and the pose is the visual one.
    pub confirmed_end_percent: f64,
    /// Error of the visual reactions, root mean square. A reaction that is not shown counts as
    /// zero.
    pub force_rms_percent: f64,
    /// The same error as a share of the root mean square of the true reactions.
    pub force_rms_of_force_percent: f64,
    /// Largest second difference of the visual reaction, as a share of the largest true reaction.
    pub force_ringing: f64,
    /// Largest second difference of the true reaction, as a share of the largest true reaction.
    pub true_ringing: f64,
    /// Time from a hand's motion to the force that answers it, ms.
    ///
    /// Between peers it is measured: the longest time from a position of the second peer's own hand
    /// to the first step whose force has that position or a newer one, and no number if that peer
    /// holds nothing. Between host and guest it is half the round trip, half a step and the mean
    /// visual delay, and no number if the policy owns the model: the guest's own copy answers then,
    /// at its next step (see [`pliant_stream::StreamedBody::predicted_hand`]), which is not
    /// measured here.
    pub hand_to_force_ms: f64,
    /// Mean time from the host's step to the showing of its tick, ms.
    ///
    /// A peer shows its own step at once. Between peers it is the mean age of the newest tick all
    /// of whose targets have acted in the second peer's picture, from the first peer's step of that
    /// tick on: how late the second peer sees the other's hand right.
    pub visual_delay_ms: f64,
    /// Longest time for which the visual error stayed above 0.5 %, ms.
    pub recover_ms: f64,
    /// Mean size of a datagram from host to guest, bytes.
    pub bytes_per_frame: f64,
    /// Data rate from host to guest, datagrams without the transport's own bytes, kbit/s.
    pub kbit_s: f64,
    /// Mean size of a datagram from guest to host, bytes. These carry the clock, loss reports and
    /// NACKs, and targets only with [`Experiment::guest_hand`].
    pub bytes_per_datagram_up: f64,
    /// Data rate from guest to host, kbit/s. See [`Metrics::bytes_per_datagram_up`].
    pub kbit_s_up: f64,
    /// Time for decoding, correcting and stepping a tick at the guest, us.
    pub cpu_us_per_tick: f64,
    /// Hash of all visual states and of the outcome of every packet.
    pub hash: u64,
    /// NACKs sent.
    pub nacks: u64,
    /// Tick counts of the guest's receiver.
    pub counts: RepairCounts,
    /// Largest true displacement, m.
    pub scale: f64,
    /// Largest true reaction, N.
    pub force_scale: f64,
    /// The first hand at each tick. See [`Experiment::keep_track`].
    pub track: Vec<TrackPoint>,
}

/// The first hand at a tick, along the axis of its largest reach.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct TrackPoint {
    /// The tick.
    pub tick: u64,
    /// True and visual displacement of the hand's patch, m.
    pub displacement: [f64; 2],
    /// True and visual reaction, N. A visual reaction that is not there is 0.
    pub reaction: [f64; 2],
}

impl Experiment {
    /// The seed of an experiment that names no other.
    pub const SEED: u64 = 1;

    /// An experiment with a path that is the same both ways and defaults for everything else.
    pub fn new(model: Arc<ModalModel>, link: LinkConfig, recovery: RecoveryConfig) -> Self {
        Self {
            hands: Self::default_hands(&model),
            model,
            recovery,
            down: link.clone(),
            up: link,
            rate: 40.0,
            seconds: 30.0,
            seed: Self::SEED,
            modes: None,
            elasticity: Elasticity::Linear,
            held_shapes: false,
            integrator: recovery.integrator(),
            relaxation: None,
            newmark: Self::our_newmark(40.0),
            resend_after: Duration::ZERO,
            warmup: Duration::from_secs(2),
            quantum: HostSessionConfig::default().quantum,
            cpu_clock: None,
            peer_repeats: PeerSessionConfig::default().repeats,
            peer_blend_ticks: PeerSessionConfig::default().blend_ticks,
            guest_hand: false,
            keep_track: false,
        }
    }

    /// Gives a stream of accelerations the paper's integrator at both ends, average acceleration:
    /// the host steps by it, and guests read accelerations by it. A stream of forces keeps its own.
    pub fn use_the_papers_integrator(&mut self) {
        if !matches!(self.recovery.policy, Policy::ForceDriven { .. }) {
            self.integrator = Integrator::Newmark;
            self.newmark = Newmark::average(1.0 / self.rate);
        }
    }

    /// Gives the host the integrator that the library has for its policy, and guests the filter of
    /// it: what an experiment has from the beginning.
    pub fn use_our_integrator(&mut self) {
        self.integrator = self.recovery.integrator();
        self.newmark = Self::our_newmark(self.rate);
    }

    /// The filter by which guests read accelerations of generalized-alpha with `rho_inf` 0.5.
    fn our_newmark(rate: f64) -> Newmark {
        Newmark { h: 1.0 / rate, beta: 4.0 / 9.0, gamma: 5.0 / 6.0 }
    }

    /// How the body is stepped.
    fn settings(&self) -> StepSettings {
        let Self { elasticity, integrator, relaxation, .. } = *self;
        StepSettings { elasticity, integrator, relaxation, ..StepSettings::default() }
    }

    /// Two hands that drag slowly. The first holds where the first mode moves most. The second
    /// holds at least 0.4 of the body's size away from it, where the first mode moves most there.
    /// The largest speed is about a tenth of the body's size a second.
    pub fn default_hands(model: &ModalModel) -> Vec<HandScript> {
        let positions = model.surface().positions();
        let size = model.size();
        let moves =
            |v: usize| (0..3).map(|a| f64::from(model.displacement_row(v as u32, a, 0)).powi(2)).sum::<f64>();
        let most = |far_from: Option<usize>| {
            let distance = |v: usize| {
                let from = far_from.map_or(positions[v], |f| positions[f]);
                (0..3).map(|k| f64::from(positions[v][k] - from[k]).powi(2)).sum::<f64>().sqrt()
            };
            (0..positions.len())
                .filter(|v| far_from.is_none() || distance(*v) > 0.4 * size)
                .max_by(|a, b| moves(*a).total_cmp(&moves(*b)))
        };
        let hand = |vertex: usize, frequency, reach: [f64; 3]| HandScript {
            vertex: vertex as u32,
            radius: 0.06 * size,
            reach: reach.map(|r| r * size),
            frequency,
            tremor: 5e-4 * size,
            holds: None,
        };
        let first = most(None).unwrap_or(0);
        let mut hands = vec![hand(first, 0.13, [0.01, 0.15, 0.12])];
        hands.extend(most(Some(first)).map(|v| hand(v, 0.17, [0.01, 0.05, 0.06])));
        hands
    }

    /// Runs the experiment.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for settings out of range, and [`StreamError::Model`] when
    /// the body cannot be stepped.
    pub fn run(&self) -> Result<Metrics, StreamError> {
        let h = 1.0 / self.rate;
        let newmark = Newmark { h, ..self.newmark };
        let mut pair = Pair::new(HostSessionConfig {
            newmark,
            resend_after: self.resend_after,
            quantum: self.quantum,
            ..Default::default()
        })?;
        let settings = self.settings();
        let config = BodyConfig { step: h, ..settings.into() };
        let body = Body::new(self.model.clone(), config).map_err(model_error)?;
        pair.host.add_body(BODY, "measured", self.model.clone(), settings)?;
        let guest = GuestSessionConfig { recovery: self.recovery, modes: self.modes, ..Default::default() };
        let perfect = LinkConfig { delay: self.down.delay, ..Default::default() };
        let path = PathConfig { down: perfect, up: self.up.clone(), max_datagram: 1200 };
        pair.join_with(guest, path, self.seed, |s| s.add_cached_model(self.model.clone()))?;
        let mut run = Run::new(self, body, h);
        // The down path loses nothing until the guest has joined, because only streaming is
        // measured.
        let joined = self.down.delay * 8 + Duration::from_secs(1) + self.warmup;
        pair.run_until(joined, &mut run);
        run.begin(joined);
        pair.measure_guests(self.cpu_clock);
        let link = &mut pair.guests[0].down;
        let mut down = self.down.clone();
        down.loss = down.loss.shifted(link.counts().sent, joined);
        link.reconfigure(down)?;
        let before = pair.host.stats(PeerId(1)).unwrap_or_default();
        let until = joined + Duration::from_secs_f64(self.seconds.clamp(0.1, 1e6));
        pair.run_until(until, &mut run);
        // The host has no counts for a guest that it has disconnected.
        let after = pair.host.stats(PeerId(1)).unwrap_or(before);
        let guest = &pair.guests[0];
        run.end(until);
        let mut metrics = run.metrics(&guest.session);
        metrics.lost = guest.down.counts().lost;
        metrics.bytes_per_frame = (after.bytes_out - before.bytes_out) as f64
            / (after.datagrams_out - before.datagrams_out).max(1) as f64;
        metrics.kbit_s = (after.bytes_out - before.bytes_out) as f64 * 8e-3 / self.seconds;
        let up = (after.bytes_in - before.bytes_in) as f64;
        metrics.bytes_per_datagram_up = up / (after.datagrams_in - before.datagrams_in).max(1) as f64;
        metrics.kbit_s_up = up * 8e-3 / self.seconds;
        metrics.hash = fold(metrics.hash, &guest.down.hash().to_le_bytes());
        metrics.cpu_us_per_tick = 1e6 * pair.guests_spent().as_secs_f64() / metrics.ticks.max(1) as f64;
        metrics.nacks = guest.session.stats().nacks;
        Ok(metrics)
    }
}

const BODY: BodyId = BodyId(1);

fn model_error(e: impl std::fmt::Display) -> StreamError {
    StreamError::Model(e.to_string())
}

fn fold(mut hash: u64, bytes: &[u8]) -> u64 {
    for b in bytes {
        hash = (hash ^ u64::from(*b)).wrapping_mul(0x0000_0100_0000_01B3);
    }
    hash
}

fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}
