//! Measures two peers: each has some of the scripted hands, and the metrics describe the second
//! peer.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{GrabConfig, HeldPlace, HeldShapes};
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss};
use pliant_stream::peer::{LateInputRepair, PeerSession, PeerSessionConfig};
use pliant_stream::{Channel, PeerId, StreamError, Tick, UserId};

use super::run::force_error;
use super::shape_error::{Picture, ShapeError};
use super::{BODY, Experiment, Metrics, RECOVERED, fold, model_error, norm};

/// Interval at which a peer's application updates its session.
const LOOK: Duration = Duration::from_millis(5);
/// Time by which both peers have joined and hold the body.
const SETTLED: Duration = Duration::from_secs(3);

/// Number of sets of shapes that are kept.
const SETS: usize = 16;

/// Reactions of the hands, N, with their users.
type Reactions = Vec<(UserId, [f64; 3])>;

struct PeerSample {
    at: Duration,
    picture: Picture,
    reactions: Reactions,
}

/// What the peers agree on at each tick, once all inputs are known.
#[derive(Default)]
struct Agreed {
    shapes: BTreeMap<Tick, Picture>,
    reactions: BTreeMap<Tick, Reactions>,
}

/// What a session of two peers leaves to be compared.
struct Session {
    seen: BTreeMap<Tick, PeerSample>,
    agreed: Agreed,
    /// What the path from the first peer lost, and its hash.
    lost: u64,
    hash: u64,
    /// Number and bytes of the datagrams that each peer sent.
    sent: [(u64, u64); 2],
    /// Processor time of the second peer.
    spent: Duration,
    /// Longest time from a position of the second peer's hand to a force that has it.
    answered: Duration,
    /// Mean age of what the second peer knows whole when it shows a step.
    known: Option<Duration>,
}

impl Experiment {
    /// Runs the experiment between two equal peers instead of host and guest.
    ///
    /// The first peer has the first hand, the second the others, and `up` and `down` are the path
    /// between them. The true state is what both agree on under rollback once all inputs are known.
    /// Compensation is compared with it as well, because it leaves each peer with a state of its
    /// own. The metrics describe what the second peer showed before that. `recovery`, `modes`,
    /// `newmark` and `resend_after` have no effect.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for settings out of range, and [`StreamError::Model`] when
    /// the body cannot be stepped.
    pub fn run_peers(&self, repair: LateInputRepair) -> Result<Metrics, StreamError> {
        let session = self.between_peers(repair)?;
        let exact = match repair {
            LateInputRepair::Rollback => None,
            LateInputRepair::Compensate => Some(self.between_peers(LateInputRepair::Rollback)?.agreed),
        };
        Ok(self.peer_metrics(&session, exact.as_ref().unwrap_or(&session.agreed)))
    }

    fn between_peers(&self, repair: LateInputRepair) -> Result<Session, StreamError> {
        let h = 1.0 / self.rate;
        let settings = self.settings();
        let peer = |number: u16| -> Result<PeerSession, StreamError> {
            let (repeats, blend_ticks) = (self.peer_repeats, self.peer_blend_ticks);
            let user = UserId(number);
            let config =
                PeerSessionConfig { user, step: h, repair, repeats, blend_ticks, ..Default::default() };
            let mut peer = PeerSession::new(config)?;
            peer.add_body(BODY, self.model.clone(), &settings)?;
            Ok(peer)
        };
        let mut peers = [peer(1)?, peer(2)?];
        peers[0].connect(Duration::ZERO, PeerId(1), UserId(2), 1200)?;
        peers[1].connect(Duration::ZERO, PeerId(0), UserId(1), 1200)?;
        let reliable = |l: &LinkConfig| LinkConfig { loss: Loss::None, keep_order: true, ..l.clone() };
        // links[k] carries the output of peer k: datagrams, then messages.
        let mut links: [[EmulatedLink; 2]; 2] = [
            [
                EmulatedLink::new(self.down.clone(), self.seed),
                EmulatedLink::new(reliable(&self.down), self.seed ^ 0x51),
            ],
            [
                EmulatedLink::new(self.up.clone(), self.seed ^ 0xFFFF_0000),
                EmulatedLink::new(reliable(&self.up), self.seed ^ 0x57),
            ],
        ];
        let rest = |index: usize| {
            let place = self.model.surface().positions().get(self.hands[index].vertex as usize);
            place.copied().unwrap_or_default().map(f64::from)
        };
        let mut grabs: Vec<Option<u16>> = vec![None; self.hands.len()];
        let mut seen: BTreeMap<Tick, PeerSample> = BTreeMap::new();
        let mut agreed = Agreed::default();
        // The positions of the second peer's first hand that no force has answered yet.
        let (mut unanswered, mut answered) = (VecDeque::<(Duration, [f64; 3])>::new(), Duration::ZERO);
        // When the first peer made its last steps, and the ages of what the second knows whole.
        let mut steps = BTreeMap::<Tick, Duration>::new();
        let (mut ages, mut shown) = (Duration::ZERO, 0_u32);
        let mut sets: Vec<(Vec<HeldPlace>, Option<Arc<HeldShapes>>)> = Vec::new();
        let mut now = Duration::ZERO;
        let until = SETTLED + Duration::from_secs_f64(self.seconds.clamp(0.1, 1e6));
        let (mut spent, mut sent) = (Duration::ZERO, [(0_u64, 0_u64); 2]);
        while now < until {
            for k in 0..2 {
                let other = 1 - k;
                let began = self.cpu_clock.map(|c| c());
                while let Some(bytes) = links[other][1].poll(now) {
                    peers[k].on_message(now, PeerId(other as u64), &bytes);
                }
                while let Some(bytes) = links[other][0].poll(now) {
                    peers[k].on_datagram(now, PeerId(other as u64), &bytes);
                }
                let t = now.as_secs_f64();
                for (index, hand) in self.hands.iter().enumerate().filter(|(i, _)| usize::from(*i > 0) == k) {
                    let (start, d) = (rest(index), hand.path(t));
                    let target = std::array::from_fn(|x| start[x] + d[x]);
                    match grabs[index] {
                        None => {
                            grabs[index] = peers[k]
                                .begin_grab(BODY, hand.vertex, hand.radius, target, GrabConfig::default())
                                .ok()
                        }
                        Some(grab) => peers[k].set_target(grab, target)?,
                    }
                    if index == 1 && now >= SETTLED {
                        unanswered.push_back((now, target));
                    }
                }
                let stepped = peers[k].update(now);
                if k == 1
                    && let (Some(clock), Some(began)) = (self.cpu_clock, began)
                {
                    spent += clock().saturating_sub(began);
                }
                if self.held_shapes {
                    for (body, places) in peers[k].shapes_to_make() {
                        // One peer's shapes are the other's.
                        let made = sets.iter().find(|(of, _)| *of == places).map(|(_, made)| made.clone());
                        let made = match made {
                            Some(made) => made,
                            None => HeldShapes::of_places(&self.model, &places)
                                .map_err(model_error)?
                                .map(Arc::new),
                        };
                        sets.push((places.clone(), made.clone()));
                        peers[k].take_shapes(body, &places, made);
                    }
                    let excess = sets.len().saturating_sub(SETS);
                    sets.drain(..excess);
                }
                while peers[k].poll_event().is_some() {}
                if k == 0 {
                    let tick = peers[0].tick();
                    steps.extend((0..stepped).map(|before| (tick.saturating_sub(before), now)));
                }
                if k == 1
                    && stepped > 0
                    && now >= SETTLED
                    && let Some(body) = peers[1].body(BODY)
                {
                    let reactions = body.grabs().iter().map(|g| (g.key.user, g.reaction)).collect();
                    let own = body.grabs().iter().find(|g| g.key.user == UserId(2));
                    // Targets are in single precision between peers.
                    let used = own.and_then(|g| {
                        let same = |t: &[f64; 3]| (0..3).all(|x| (t[x] - g.target[x]).abs() < 1e-6);
                        unanswered.iter().rposition(|(_, target)| same(target))
                    });
                    for (at, _) in unanswered.drain(..used.map_or(0, |last| last + 1)) {
                        answered = answered.max(now - at);
                    }
                    // What is never answered has been waiting since then.
                    answered = unanswered.front().map_or(answered, |(at, _)| answered.max(now - *at));
                    let known = peers[1].confirmed();
                    steps = steps.split_off(&known);
                    if let Some(at) = steps.get(&known) {
                        (ages, shown) = (ages + (now - *at), shown + 1);
                    }
                    seen.insert(
                        peers[1].tick(),
                        PeerSample {
                            at: now,
                            picture: Picture { q: body.visual().q.clone(), pose: body.pose() },
                            reactions,
                        },
                    );
                }
                while let Some(out) = peers[k].poll_output() {
                    let channel = usize::from(out.channel == Channel::Message);
                    if channel == 0 && now >= SETTLED {
                        sent[k] = (sent[k].0 + 1, sent[k].1 + out.bytes.len() as u64);
                    }
                    links[k][channel].send(now, out.bytes.to_vec(), out.bytes.len());
                }
            }
            // The confirmed state of the first peer counts as the true state.
            let confirmed = peers[0].confirmed();
            let next = agreed.shapes.keys().next_back().map_or(0, |last| last + 1);
            for tick in next.min(confirmed.saturating_sub(8))..=confirmed {
                if let Some(state) = peers[0].state_at(BODY, tick) {
                    let pose = peers[0].pose_at(BODY, tick);
                    agreed.shapes.insert(tick, Picture { q: state.q.clone(), pose });
                    if let Some(r) = peers[0].reactions_at(BODY, tick) {
                        agreed.reactions.insert(tick, r);
                    }
                }
            }
            now += LOOK;
        }
        let link = &links[0][0];
        let (lost, hash) = (link.counts().lost, link.hash());
        // A peer that never knows a whole tick has no such age.
        let known = (shown > 0).then(|| ages / shown);
        Ok(Session { seen, agreed, lost, sent, hash, spent, answered, known })
    }

    fn peer_metrics(&self, session: &Session, agreed: &Agreed) -> Metrics {
        let Session { seen, sent, .. } = session;
        // The start of the grabs is not measured, nor is the end, on which nobody agrees yet.
        let Some(first) = seen.keys().next().copied() else { return Metrics::default() };
        let truth: Vec<(Tick, &Picture)> = agreed.shapes.range(first..).map(|(t, seen)| (*t, seen)).collect();
        let shape = ShapeError::new(&self.model);
        let scale = truth.iter().map(|(_, real)| shape.size(real).1.sqrt()).fold(0.0, f64::max);
        let all = || agreed.reactions.range(first..).flat_map(|(_, r)| r);
        let force_scale = all().map(|r| norm(r.1)).fold(0.0, f64::max);
        let mut f = Metrics { scale, force_scale, lost: session.lost, ..Metrics::default() };
        let (mut sum, mut motion, mut largest, mut last) = (0.0, 0.0, 0.0_f64, 0.0);
        let (mut force, mut force_motion, mut forces) = (0.0, 0.0, 0_u64);
        let (mut above, mut longest) = (None, Duration::ZERO);
        let mut hash = 0xCBF2_9CE4_8422_2325;
        let mut picture = seen.get(&first);
        for (tick, real) in truth {
            // The picture of the last tick that was shown stands in the place of one that was not.
            if let Some(shown) = seen.get(&tick) {
                picture = Some(shown);
                f.ticks += 1;
                hash = shown.picture.fold(hash);
            } else {
                f.missing += 1;
            }
            let Some(s) = picture else { continue };
            let (total, most) = shape.compare(&s.picture, real);
            sum += total;
            motion += shape.size(real).0;
            largest = largest.max(most);
            last = most;
            if most.sqrt() > RECOVERED * scale {
                let from: &mut Duration = above.get_or_insert(s.at);
                longest = longest.max(s.at.saturating_sub(*from));
            } else {
                above = None;
            }
            if let Some(real) = agreed.reactions.get(&tick) {
                let (error, size, count) = force_error(real, &s.reactions);
                (force, force_motion, forces) = (force + error, force_motion + size, forces + count);
            }
        }
        let second = |series: Vec<[f64; 3]>| {
            let all =
                series.windows(3).map(|w| norm(std::array::from_fn(|k| w[2][k] - 2.0 * w[1][k] + w[0][k])));
            all.fold(0.0, f64::max)
        };
        let of_first = |r: &[(UserId, [f64; 3])]| r.iter().find(|r| r.0 == UserId(1)).map(|r| r.1);
        let percent = |x: f64, scale: f64| if scale > 0.0 { 100.0 * x / scale } else { 0.0 };
        let ticks = (f.ticks + f.missing).max(1) as f64;
        f.rms_percent = percent((sum / ticks / shape.places()).sqrt(), scale);
        f.rms_of_motion_percent = percent(sum.sqrt(), motion.sqrt());
        f.max_percent = percent(largest.sqrt(), scale);
        f.end_percent = percent(last.sqrt(), scale);
        f.force_rms_percent = percent((force / forces.max(1) as f64).sqrt(), force_scale);
        f.force_rms_of_force_percent = percent(force.sqrt(), force_motion.sqrt());
        f.force_ringing =
            second(seen.values().filter_map(|s| of_first(&s.reactions)).collect()) / force_scale.max(1e-12);
        f.true_ringing = second(agreed.reactions.range(first..).filter_map(|(_, r)| of_first(r)).collect())
            / force_scale.max(1e-12);
        let own = self.hands.len() > 1;
        f.hand_to_force_ms = if own { session.answered.as_secs_f64() * 1e3 } else { f64::NAN };
        f.visual_delay_ms = session.known.map_or(f64::NAN, |known| known.as_secs_f64() * 1e3);
        f.recover_ms = longest.as_secs_f64() * 1e3;
        let [down, up] = *sent;
        f.bytes_per_frame = down.1 as f64 / down.0.max(1) as f64;
        f.kbit_s = down.1 as f64 * 8e-3 / self.seconds;
        f.bytes_per_datagram_up = up.1 as f64 / up.0.max(1) as f64;
        f.kbit_s_up = up.1 as f64 * 8e-3 / self.seconds;
        f.cpu_us_per_tick = 1e6 * session.spent.as_secs_f64() / f.ticks.max(1) as f64;
        f.hash = fold(hash, &session.hash.to_le_bytes());
        f
    }
}
