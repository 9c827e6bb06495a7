//! Streaming measured: one body, scripted hands, an emulated path, and the figures of what a guest was shown.
//!
//! All in virtual time: ten minutes of a session take seconds, and the same seed gives the same figures and the same hash.

mod peers;
mod run;
mod shape_error;

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{Body, BodyConfig, Integrator, ModalModel, Relaxation, StepSettings};
use pliant_stream::emulator::LinkConfig;
use pliant_stream::{
    BodyId, GuestConfig, HostConfig, Newmark, PeerId, RecoveryConfig, RepairCounts, StreamError,
};

use crate::pair::{Pair, PathConfig};
use run::Run;
use shape_error::ShapeError;

/// Shown error above which a body counts as not recovered, share of the largest displacement.
const RECOVERED: f64 = 0.005;

/// What to measure.
#[derive(Debug, Clone)]
pub struct Experiment {
    /// The body.
    pub model: Arc<ModalModel>,
    /// How the guest repairs.
    pub recovery: RecoveryConfig,
    /// The path down, where frames travel.
    pub down: LinkConfig,
    /// The path up, where NACKs and targets travel.
    pub up: LinkConfig,
    /// Steps a second. Default: 40.
    pub rate: f64,
    /// How long, s, after the guest has joined. Default: 30.
    pub seconds: f64,
    /// Default: 1.
    pub seed: u64,
    /// Modes streamed. Default: all.
    pub modes: Option<u16>,
    /// The host's integrator. Default: exact.
    pub integrator: Integrator,
    /// A material that relaxes. Default: none, elastic.
    pub relaxation: Option<Relaxation>,
    /// The filter of acceleration streams; its `h` is taken from `rate`. Default: beta 4/9, gamma 5/6.
    pub newmark: Newmark,
    /// Answer NACKs only so much later. Default: at once.
    pub resend_after: Duration,
    /// The body moves for so long before the path is let loose on the stream; scheduled losses count from then on.
    /// Default: 2 s.
    pub warmup: Duration,
    /// Hands, scripted. Default: [`Experiment::default_hands`].
    pub hands: Vec<Hand>,
    /// [`HostConfig::quantum`]. Default: 2^-14.
    pub quantum: f64,
    /// A clock for the time that decoding, correcting and stepping take; `None` leaves [`Metrics::cpu_us_per_tick`] 0.
    pub cpu_clock: Option<fn() -> Duration>,
    /// The guest holds the body, too, where the first hand does, and sends its target every tick: for counting what goes up. The host does not
    /// act on it, so what is shown is not compared with anything then: the errors mean nothing. Default: false.
    pub guest_hand: bool,
    /// Keep the shown and true position of the first hand's patch, tick by tick, for plots. Default: false.
    pub keep_track: bool,
}

/// A scripted hand: it circles about where it took hold on a smooth path that never repeats, and trembles a little.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hand {
    /// Center of the patch.
    pub vertex: u32,
    /// Radius of the patch, m.
    pub radius: f64,
    /// Largest distance from the start along each axis, m.
    pub reach: [f64; 3],
    /// Slowest frequency, Hz; the path adds two more at 1.618 and 2.414 times it.
    pub frequency: f64,
    /// Size of the tremor that every hand has, m: 9.3 and 11.7 Hz on top of the path.
    pub tremor: f64,
    /// When it takes hold and lets go, s since the start; `None`: all the time.
    pub holds: Option<(f64, f64)>,
}

impl Hand {
    /// Displacement of the hand from where it took hold, m, at a time since then, s.
    pub fn path(&self, t: f64) -> [f64; 3] {
        let w = std::f64::consts::TAU * self.frequency * t;
        // Starts from rest: the ramp has no corner.
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

/// What a run showed. Percentages are of the largest true displacement (reactions: of the largest true reaction).
#[derive(Debug, Clone, PartialEq, Default, serde::Serialize)]
pub struct Metrics {
    /// Ticks that the guest was shown.
    pub ticks: u64,
    /// Ticks that it was not shown in time: the picture stood still, or went past them. In the errors each counts as the picture that stood in its
    /// place, against the truth of that tick. Between peers, which step on time by themselves, always 0.
    pub missing: u64,
    /// Frames that the path lost.
    pub lost: u64,
    /// Ticks that were stepped on a guess.
    pub guessed: u64,
    /// Of these the ones put right later.
    pub recovered: u64,
    /// Shown error, root mean square over ticks (the missing ones too) and places.
    pub rms_percent: f64,
    /// Shown error, largest.
    pub max_percent: f64,
    /// Shown error at the last tick, shown or missing.
    pub end_percent: f64,
    /// Hidden error at the last tick.
    pub hidden_end_percent: f64,
    /// Error of the shown reactions, root mean square.
    pub force_rms_percent: f64,
    /// max |second difference| / max |reaction| of the shown reaction.
    pub force_ringing: f64,
    /// The same of the true reaction.
    pub true_ringing: f64,
    /// From a hand's motion to the force that answers it, ms; reckoned, not timed. Where the policy owns the model it is one
    /// tick by construction (the guest's own copy answers at its next step, see [`pliant_stream::BodyView::predicted_hand`]), else the round trip and the delays on the way.
    pub hand_to_force_ms: f64,
    /// How far the shown tick lies behind its step at the host, ms, mean.
    pub shown_delay_ms: f64,
    /// Longest time for which the shown error stayed above 0.5 %, ms.
    pub recover_ms: f64,
    /// Mean bytes of a datagram down.
    pub bytes_per_frame: f64,
    /// Bits down in a second, datagrams without the transport's own bytes, kbit/s.
    pub kbit_s: f64,
    /// Mean bytes of a datagram up, and bits up in a second: kbit/s. Clock, loss reports and NACKs; targets only with
    /// [`Experiment::guest_hand`].
    pub bytes_per_datagram_up: f64,
    /// See [`Metrics::bytes_per_datagram_up`].
    pub kbit_s_up: f64,
    /// Time for decoding, correcting and stepping a tick at the guest, us.
    pub cpu_us_per_tick: f64,
    /// Everything shown and every fate on the path, in one number.
    pub hash: u64,
    /// NACKs sent.
    pub nacks: u64,
    /// What became of the ticks.
    pub counts: RepairCounts,
    /// Largest true displacement, m.
    pub scale: f64,
    /// Largest true reaction, N.
    pub force_scale: f64,
    /// Tick, true and shown displacement of the first hand's patch along its largest reach, m; see
    /// [`Experiment::keep_track`].
    pub track: Vec<(u64, f64, f64)>,
}

impl Experiment {
    /// A model over a path that is alike both ways, with everything else by default.
    pub fn new(model: Arc<ModalModel>, link: LinkConfig, recovery: RecoveryConfig) -> Self {
        Self {
            hands: Self::default_hands(&model),
            model,
            recovery,
            down: link.clone(),
            up: link,
            rate: 40.0,
            seconds: 30.0,
            seed: 1,
            modes: None,
            integrator: Integrator::default(),
            relaxation: None,
            newmark: Newmark { h: 1.0 / 40.0, beta: 4.0 / 9.0, gamma: 5.0 / 6.0 },
            resend_after: Duration::ZERO,
            warmup: Duration::from_secs(2),
            quantum: HostConfig::default().quantum,
            cpu_clock: None,
            guest_hand: false,
            keep_track: false,
        }
    }

    /// Two hands that drag slowly: one where the first mode moves most, one at least 0.4 of the body's size away from it,
    /// where the first mode moves most there. The largest speed is about a tenth of the body's size a second.
    pub fn default_hands(model: &ModalModel) -> Vec<Hand> {
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
        let hand = |vertex: usize, frequency, reach: [f64; 3]| Hand {
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

    /// Runs it.
    ///
    /// # Errors
    /// [`StreamError::Config`] for settings out of range, [`StreamError::Model`] when the body cannot be stepped.
    pub fn run(&self) -> Result<Metrics, StreamError> {
        let h = 1.0 / self.rate;
        let newmark = Newmark { h, ..self.newmark };
        let mut pair = Pair::new(HostConfig {
            newmark,
            resend_after: self.resend_after,
            quantum: self.quantum,
            ..Default::default()
        })?;
        let settings =
            StepSettings { integrator: self.integrator, relaxation: self.relaxation, ..Default::default() };
        let config = BodyConfig { step: h, ..settings.into() };
        let body = Body::new(self.model.clone(), config).map_err(model_error)?;
        pair.host.add_body(BODY, "measured", self.model.clone(), settings)?;
        let guest = GuestConfig { recovery: self.recovery, modes: self.modes, ..Default::default() };
        let perfect = LinkConfig { delay: self.down.delay, ..Default::default() };
        let path = PathConfig { down: perfect, up: self.up.clone(), max_datagram: 1200 };
        pair.join_with(guest, path, self.seed, |s| s.add_cached_model(self.model.clone()))?;
        let mut run = Run::new(self, body, h);
        // Joining happens on the same path without loss: what is measured is streaming.
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
        // A guest that the host has let go has no counts any more.
        let after = pair.host.stats(PeerId(1)).unwrap_or(before);
        let guest = &pair.guests[0];
        run.end(until);
        let mut figures = run.figures(&guest.session);
        figures.lost = guest.down.counts().lost;
        figures.bytes_per_frame = (after.bytes_out - before.bytes_out) as f64
            / (after.datagrams_out - before.datagrams_out).max(1) as f64;
        figures.kbit_s = (after.bytes_out - before.bytes_out) as f64 * 8e-3 / self.seconds;
        let up = (after.bytes_in - before.bytes_in) as f64;
        figures.bytes_per_datagram_up = up / (after.datagrams_in - before.datagrams_in).max(1) as f64;
        figures.kbit_s_up = up * 8e-3 / self.seconds;
        figures.hash = fold(figures.hash, &guest.down.hash().to_le_bytes());
        figures.cpu_us_per_tick = 1e6 * pair.guests_spent().as_secs_f64() / figures.ticks.max(1) as f64;
        figures.nacks = guest.session.stats().nacks;
        Ok(figures)
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
