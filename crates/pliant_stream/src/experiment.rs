//! Streaming measured: one body, scripted hands, an emulated path, and the figures of what a guest was shown.
//!
//! All in virtual time: ten minutes of a session take seconds, and the same seed gives the same figures and the same hash.

mod shape_error;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{Body, BodyConfig, GrabConfig, GrabId, Integrator, ModalModel, Patch, Relaxation};

use crate::StreamError;
use crate::emulator::LinkConfig;
use crate::newmark::Newmark;
use crate::pair::{Pair, PathConfig, World};
use crate::recovery::{Policy, RecoveryConfig, RepairCounts};
use crate::session::{GuestConfig, GuestSession, HostConfig, HostEvent, HostSession};
use crate::state::{BodyId, GrabKey, GrabState, Pose, TickState, UserId};
use crate::stepper::BodySetup;

pub(crate) use shape_error::ShapeError;

/// Truth kept for comparison, ticks.
const KEPT: usize = 4096;
/// Shown error above which a body counts as not recovered, share of the largest displacement.
pub(crate) const RECOVERED: f64 = 0.005;

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
    /// A clock for the time that decoding, correcting and stepping take; `None` leaves [`Figures::cpu_us_per_tick`] 0.
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
    /// Centre of the patch.
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
pub struct Figures {
    /// Ticks that the guest was shown.
    pub ticks: u64,
    /// Frames that the path lost.
    pub lost: u64,
    /// Ticks that were stepped on a guess.
    pub guessed: u64,
    /// Of these the ones put right later.
    pub recovered: u64,
    /// Shown error, root mean square over ticks and places.
    pub rms_percent: f64,
    /// Shown error, largest.
    pub max_percent: f64,
    /// Shown error at the last tick.
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
    /// tick by construction (the guest's own copy answers at its next step, see [`crate::BodyView::own_hand`]), else the round trip and the delays on the way.
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
    /// See [`Figures::bytes_per_datagram_up`].
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
    pub fn run(&self) -> Result<Figures, StreamError> {
        let h = 1.0 / self.rate;
        let newmark = Newmark { h, ..self.newmark };
        let mut pair = Pair::new(HostConfig {
            newmark,
            resend_after: self.resend_after,
            quantum: self.quantum,
            ..Default::default()
        })?;
        let body = Body::new(
            self.model.clone(),
            BodyConfig {
                step: h,
                integrator: self.integrator,
                relaxation: self.relaxation,
                ..Default::default()
            },
        )
        .map_err(model_error)?;
        let setup =
            BodySetup { integrator: self.integrator, relaxation: self.relaxation, ..Default::default() };
        pair.host.add_body(BODY, "measured", self.model.clone(), setup)?;
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
        let before = pair.host.stats(crate::state::PeerId(1)).unwrap_or_default();
        let until = joined + Duration::from_secs_f64(self.seconds.clamp(0.1, 1e6));
        pair.run_until(until, &mut run);
        let after = pair.host.stats(crate::state::PeerId(1)).unwrap_or_default();
        let guest = &pair.guests[0];
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

pub(crate) const BODY: BodyId = BodyId(1);

fn model_error(e: impl std::fmt::Display) -> StreamError {
    StreamError::Model(e.to_string())
}

pub(crate) fn fold(mut hash: u64, bytes: &[u8]) -> u64 {
    for b in bytes {
        hash = (hash ^ u64::from(*b)).wrapping_mul(0x0000_0100_0000_01B3);
    }
    hash
}

struct Held {
    hand: Hand,
    grab: Option<(GrabId, [f64; 3], f64)>,
}

struct Truth {
    tick: u64,
    at: Duration,
    q: Vec<f64>,
    reactions: Vec<(GrabKey, [f64; 3])>,
}

/// The world around the session: the true body, its hands, and the comparison.
struct Run {
    body: Body,
    h: f64,
    hands: Vec<Held>,
    truth: VecDeque<Truth>,
    shape: ShapeError,
    track_row: Vec<f64>,
    keep_track: bool,
    /// Who holds at the guest: the hand, and the grab once there is one.
    guest_hand: Option<(Hand, Option<u16>)>,
    /// When it last said its target.
    guest_said: Duration,
    own_hand_first: bool,
    measuring: Option<Duration>,
    sum: f64,
    count: u64,
    largest: f64,
    last: f64,
    hidden_last: f64,
    scale: f64,
    force_sum: f64,
    force_count: u64,
    force_scale: f64,
    shown_force: Vec<([f64; 3], [f64; 3])>,
    true_force: Vec<([f64; 3], [f64; 3])>,
    shown_second: f64,
    true_second: f64,
    delay_sum: f64,
    above: Vec<(Duration, f64)>,
    hash: u64,
    track: Vec<(u64, f64, f64)>,
    last_tick: u64,
    /// Ticks shown one after the other up to now.
    in_row: u64,
}

impl Run {
    fn new(experiment: &Experiment, body: Body, h: f64) -> Self {
        let model = &experiment.model;
        let modes = model.mode_count();
        let shape = ShapeError::new(model);
        let track_row = experiment.hands.first().map_or(Vec::new(), |hand| {
            let axis = (0..3).max_by(|a, b| hand.reach[*a].total_cmp(&hand.reach[*b])).unwrap_or(0);
            (0..modes).map(|mode| f64::from(model.displacement_row(hand.vertex, axis, mode))).collect()
        });
        Self {
            body,
            h,
            hands: experiment.hands.iter().map(|h| Held { hand: *h, grab: None }).collect(),
            truth: VecDeque::with_capacity(KEPT),
            shape,
            track_row,
            keep_track: experiment.keep_track,
            guest_hand: experiment.hands.first().filter(|_| experiment.guest_hand).map(|hand| (*hand, None)),
            guest_said: Duration::ZERO,
            own_hand_first: matches!(experiment.recovery.policy, Policy::ForceDriven { .. }),
            measuring: None,
            sum: 0.0,
            count: 0,
            largest: 0.0,
            last: 0.0,
            hidden_last: 0.0,
            scale: 0.0,
            force_sum: 0.0,
            force_count: 0,
            force_scale: 0.0,
            shown_force: Vec::new(),
            true_force: Vec::new(),
            shown_second: 0.0,
            true_second: 0.0,
            delay_sum: 0.0,
            above: Vec::new(),
            hash: 0xCBF2_9CE4_8422_2325,
            track: Vec::new(),
            last_tick: 0,
            in_row: 0,
        }
    }

    /// The guest's own hand, on the path of the first one of the host.
    fn hold_at_guest(&mut self, now: Duration, session: &mut GuestSession) {
        let Some((hand, grab)) = &mut self.guest_hand else { return };
        // Once a tick: a target that is said makes the session look again at once.
        if now.saturating_sub(self.guest_said).as_secs_f64() < 0.9 * self.h {
            return;
        }
        self.guest_said = now;
        let place = self.body.model().surface().positions().get(hand.vertex as usize).copied();
        let (rest, d) = (place.unwrap_or_default(), hand.path(now.as_secs_f64()));
        let target = std::array::from_fn(|k| f64::from(rest[k]) + d[k]);
        match grab {
            // Refused before the body is there: again at the next tick.
            None => {
                let hold = GrabConfig::default();
                *grab = session.begin_grab(now, BODY, hand.vertex, hand.radius, target, hold).ok();
            }
            // A finite hand's target is taken.
            Some(grab) => drop(session.set_target(*grab, target)),
        }
    }

    fn begin(&mut self, now: Duration) {
        self.measuring = Some(now);
    }

    fn figures(&self, session: &GuestSession) -> Figures {
        let percent = |x: f64, scale: f64| if scale > 0.0 { 100.0 * x / scale } else { 0.0 };
        let counts = session.body(BODY).map(|b| b.counts()).unwrap_or_default();
        let places = self.shape.places();
        let ticks = self.count.max(1) as f64;
        let ratio = |a: f64, b: f64| if b > 0.0 { a / b } else { 0.0 };
        // The longest spell of shown error above the threshold.
        let (mut longest, mut since) = (Duration::ZERO, None);
        for (at, error) in &self.above {
            if *error > RECOVERED * self.scale {
                let from = *since.get_or_insert(*at);
                longest = longest.max(*at - from);
            } else {
                since = None;
            }
        }
        let delay = self.delay_sum / ticks;
        Figures {
            ticks: self.count,
            guessed: counts.guessed,
            recovered: counts.repaired,
            rms_percent: percent((self.sum / ticks / places).sqrt(), self.scale),
            max_percent: percent(self.largest.sqrt(), self.scale),
            end_percent: percent(self.last.sqrt(), self.scale),
            hidden_end_percent: percent(self.hidden_last.sqrt(), self.scale),
            force_rms_percent: percent(
                (self.force_sum / self.force_count.max(1) as f64).sqrt(),
                self.force_scale,
            ),
            force_ringing: ratio(self.shown_second, self.force_scale),
            true_ringing: ratio(self.true_second, self.force_scale),
            hand_to_force_ms: 1e3
                * if self.own_hand_first {
                    // The guest's newer copy answers at its next tick.
                    self.h
                } else {
                    // A target leaves with the guest's tick, waits for the host's next step (half a step on average),
                    // and its reaction comes back and is shown.
                    session.stats().round_trip.as_secs_f64() * 0.5 + 0.5 * self.h + delay
                },
            shown_delay_ms: 1e3 * delay,
            recover_ms: longest.as_secs_f64() * 1e3,
            hash: self.hash,
            counts,
            scale: self.scale,
            force_scale: self.force_scale,
            track: self.track.clone(),
            ..Figures::default()
        }
    }
}

impl World for Run {
    fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession) {
        let t = now.as_secs_f64();
        for (index, held) in self.hands.iter_mut().enumerate() {
            let holds = held.hand.holds.is_none_or(|(from, to)| (from..to).contains(&t));
            match (&held.grab, holds) {
                (None, true) => {
                    let patch =
                        Patch::around(self.body.model().surface(), held.hand.vertex, held.hand.radius);
                    if let Ok(patch) = patch
                        && let Ok(id) = self.body.grab(&patch, GrabConfig::default())
                        && let Ok(start) = self.body.grab_position(id)
                    {
                        held.grab = Some((id, start, t));
                    }
                }
                (Some((id, ..)), false) => {
                    self.body.release(*id);
                    held.grab = None;
                }
                _ => {}
            }
            if let Some((id, start, since)) = held.grab {
                let d = held.hand.path(t - since + 0.1 * index as f64);
                // A target out of range cannot come from finite hands.
                let _ = self.body.set_target(id, std::array::from_fn(|k| start[k] + d[k]));
            }
        }
        if self.body.step().is_err() {
            return;
        }
        let grabs: Vec<GrabState> = self
            .hands
            .iter()
            .enumerate()
            .filter_map(|(index, held)| {
                let (id, ..) = held.grab?;
                Some(GrabState {
                    key: GrabKey { user: UserId::HOST, grab: index as u16 },
                    vertex: held.hand.vertex,
                    radius: held.hand.radius,
                    target: self.body.target(id).ok()?,
                    reaction: self.body.reaction(id).ok()?,
                })
            })
            .collect();
        let pose = self.body.model().is_free().then(|| Pose::of(&self.body));
        let state = TickState {
            tick,
            q: self.body.q(),
            v: self.body.v(),
            a: self.body.a(),
            z: self.body.z(),
            pose,
            grabs: &grabs,
            resting: false,
        };
        // A state that cannot be published shows as ticks that never arrive.
        let _ = host.publish(now, BODY, &state);
        if self.truth.len() >= KEPT {
            self.truth.pop_front();
        }
        if self.measuring.is_some() {
            let (_, largest) = self.shape.compare(self.body.q(), &[]);
            self.scale = self.scale.max(largest.sqrt());
            for g in &grabs {
                self.force_scale = self.force_scale.max(norm(g.reaction));
            }
        }
        self.truth.push_back(Truth {
            tick,
            at: now,
            q: self.body.q().to_vec(),
            reactions: grabs.iter().map(|g| (g.key, g.reaction)).collect(),
        });
    }

    fn host_event(&mut self, _now: Duration, _event: HostEvent, _host: &mut HostSession) {}

    fn guest_stepped(&mut self, now: Duration, _guest: usize, _stepped: u64, session: &mut GuestSession) {
        self.hold_at_guest(now, session);
        let Some(view) = session.body(BODY) else { return };
        let (Some(shown), Some(hidden)) = (view.shown(), view.hidden()) else { return };
        let tick = view.tick();
        if self.measuring.is_none() || tick <= self.last_tick {
            return;
        }
        // Second differences are taken of ticks that follow each other; a stall that is caught up with shows as error.
        self.in_row = if tick == self.last_tick + 1 { self.in_row + 1 } else { 0 };
        self.last_tick = tick;
        let Some(first) = self.truth.front().map(|t| t.tick) else { return };
        let Some(truth) = tick.checked_sub(first).and_then(|i| self.truth.get(i as usize)) else { return };
        let modes = shown.q.len();
        let (sum, largest) = self.shape.compare(&shown.q, &truth.q[..modes]);
        let (_, hidden_largest) = self.shape.compare(&hidden.q, &truth.q[..modes]);
        let at = truth.at;
        let (mut force, mut forces) = (0.0, 0);
        self.shown_force.resize(view.grabs().len().max(self.shown_force.len()), ([0.0; 3], [0.0; 3]));
        self.true_force.resize(self.shown_force.len(), ([0.0; 3], [0.0; 3]));
        for (i, g) in view.grabs().iter().enumerate() {
            let Some((_, reaction)) = truth.reactions.iter().find(|r| r.0 == g.key) else { continue };
            force += (0..3).map(|k| (g.reaction[k] - reaction[k]).powi(2)).sum::<f64>();
            forces += 1;
            for (series, new, second) in [
                (&mut self.shown_force[i], g.reaction, &mut self.shown_second),
                (&mut self.true_force[i], *reaction, &mut self.true_second),
            ] {
                if self.in_row >= 2 {
                    let d = std::array::from_fn(|k| new[k] - 2.0 * series.1[k] + series.0[k]);
                    *second = second.max(norm(d));
                }
                *series = (series.1, new);
            }
        }
        if self.keep_track {
            let dot = |q: &[f64]| q.iter().zip(&self.track_row).map(|(q, r)| q * r).sum::<f64>();
            let entry = (tick, dot(&truth.q), dot(&shown.q));
            self.track.push(entry);
        }
        self.force_sum += force;
        self.force_count += forces;
        self.sum += sum;
        self.count += 1;
        self.largest = self.largest.max(largest);
        self.last = largest;
        self.hidden_last = hidden_largest;
        self.delay_sum += now.saturating_sub(at).as_secs_f64();
        self.above.push((now, largest.sqrt()));
        for q in &shown.q {
            self.hash = fold(self.hash, &q.to_bits().to_le_bytes());
        }
    }
}

pub(crate) fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}
