//! The caller's side of a measured session: the true body, its hands and the comparison with the
//! guest.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{Body, GrabConfig, GrabId, Patch};
use pliant_stream::{
    GrabKey, GrabState, GuestSession, HostEvent, HostSession, Policy, RigidState, TickState, UserId,
};

use super::shape_error::{Picture, ShapeError};
use super::{BODY, Experiment, HandScript, Metrics, RECOVERED, TrackPoint, norm};
use crate::pair::World;

/// True states kept for comparison, ticks.
const KEPT: usize = 4096;

struct ExperimentGrab {
    hand: HandScript,
    grab: Option<(GrabId, [f64; 3], f64)>,
}

struct Truth {
    tick: u64,
    at: Duration,
    picture: Picture,
    reactions: Vec<(GrabKey, [f64; 3])>,
}

/// Squared error of the shown reactions, squared true reactions (N^2) and number of the true ones.
/// A reaction that is not shown counts as zero, so that its error is the whole true reaction.
pub(super) fn force_error<K: PartialEq>(truth: &[(K, [f64; 3])], shown: &[(K, [f64; 3])]) -> (f64, f64, u64) {
    let (mut error, mut size) = (0.0, 0.0);
    for (key, real) in truth {
        let shown = shown.iter().find(|r| r.0 == *key).map_or([0.0; 3], |r| r.1);
        error += (0..3).map(|k| (shown[k] - real[k]).powi(2)).sum::<f64>();
        size += real.iter().map(|x| x * x).sum::<f64>();
    }
    (error, size, truth.len() as u64)
}

/// The caller's side of the session: the true body, its hands and the comparison.
pub(super) struct Run {
    body: Body,
    h: f64,
    hands: Vec<ExperimentGrab>,
    truth: VecDeque<Truth>,
    shape: ShapeError,
    /// The axis of the tracks, and the first hand's vertex.
    track_axis: usize,
    track_hand: ShapeError,
    keep_track: bool,
    held_shapes: bool,
    /// The guest's hand, and its grab once it has begun.
    guest_hand: Option<(HandScript, Option<u16>)>,
    /// Time at which the guest last sent its target.
    guest_sent: Duration,
    predict_hand: bool,
    measuring: Option<Duration>,
    sum: f64,
    /// Sum of the squared true displacements of the compared ticks, m^2.
    motion: f64,
    /// Ticks shown, and ticks shown or missed.
    count: u64,
    compared: u64,
    missing: u64,
    largest: f64,
    last: f64,
    confirmed_last: f64,
    scale: f64,
    /// Sums of the squared errors of the shown reactions and of the squared true ones, N^2.
    force_sum: f64,
    force_motion: f64,
    force_count: u64,
    force_scale: f64,
    visual_force: Vec<([f64; 3], [f64; 3])>,
    true_force: Vec<([f64; 3], [f64; 3])>,
    visual_second: f64,
    true_second: f64,
    delay_sum: f64,
    above: Vec<(Duration, f64)>,
    hash: u64,
    track: Vec<TrackPoint>,
    last_tick: u64,
    /// Time of the last shown tick, and what it showed, which stays visible until the next shown
    /// tick.
    displayed_at: Option<Duration>,
    picture: Picture,
    /// The reactions that were shown with it. A device goes on playing them.
    played: Vec<(GrabKey, [f64; 3])>,
    /// Ticks missed since then.
    stalled: u64,
    /// Number of consecutive ticks shown up to the last one.
    in_row: u64,
}

impl Run {
    pub(super) fn new(experiment: &Experiment, body: Body, h: f64) -> Self {
        let model = &experiment.model;
        let shape = ShapeError::new(model);
        let reach = experiment.hands.first().map_or([0.0; 3], |hand| hand.reach);
        let track_axis = (0..3).max_by(|a, b| reach[*a].total_cmp(&reach[*b])).unwrap_or(0);
        let track_hand = ShapeError::at(model, experiment.hands.first().map_or(0, |hand| hand.vertex));
        Self {
            body,
            h,
            hands: experiment.hands.iter().map(|h| ExperimentGrab { hand: *h, grab: None }).collect(),
            truth: VecDeque::with_capacity(KEPT),
            shape,
            track_axis,
            track_hand,
            keep_track: experiment.keep_track,
            held_shapes: experiment.held_shapes,
            guest_hand: experiment.hands.first().filter(|_| experiment.guest_hand).map(|hand| (*hand, None)),
            guest_sent: Duration::ZERO,
            predict_hand: matches!(experiment.recovery.policy, Policy::ForceDriven { .. }),
            measuring: None,
            sum: 0.0,
            motion: 0.0,
            count: 0,
            compared: 0,
            missing: 0,
            largest: 0.0,
            last: 0.0,
            confirmed_last: 0.0,
            scale: 0.0,
            force_sum: 0.0,
            force_motion: 0.0,
            force_count: 0,
            force_scale: 0.0,
            visual_force: Vec::new(),
            true_force: Vec::new(),
            visual_second: 0.0,
            true_second: 0.0,
            delay_sum: 0.0,
            above: Vec::new(),
            hash: 0xCBF2_9CE4_8422_2325,
            track: Vec::new(),
            last_tick: 0,
            displayed_at: None,
            picture: Picture::default(),
            played: Vec::new(),
            stalled: 0,
            in_row: 0,
        }
    }

    /// Moves the guest's own hand on the path of the host's first hand.
    fn hold_at_guest(&mut self, now: Duration, session: &mut GuestSession) {
        let Some((hand, grab)) = &mut self.guest_hand else { return };
        // Send once per tick, because a new target makes the session update again at once.
        if now.saturating_sub(self.guest_sent).as_secs_f64() < 0.9 * self.h {
            return;
        }
        self.guest_sent = now;
        let place = self.body.model().surface().positions().get(hand.vertex as usize).copied();
        let (rest, d) = (place.unwrap_or_default(), hand.path(now.as_secs_f64()));
        let target = std::array::from_fn(|k| f64::from(rest[k]) + d[k]);
        match grab {
            // The session refuses the grab until it has the body, so try again at the next tick.
            None => {
                let hold = GrabConfig::default();
                *grab = session.begin_grab(now, BODY, hand.vertex, hand.radius, target, hold).ok();
            }
            // The session accepts every finite target.
            Some(grab) => drop(session.set_target(*grab, target)),
        }
    }

    /// Gives the guest's own hand the shapes that the host has.
    fn shape_at_guest(&self, session: &mut GuestSession) {
        let Some(view) = session.body(BODY).filter(|_| self.guest_hand.is_some()) else { return };
        let [own, host] = [view.held_shapes().map(|(shapes, _)| shapes), self.body.held_shapes()];
        if own.map(Arc::as_ptr) != host.map(Arc::as_ptr) && !view.held_places().is_empty() {
            let shapes = host.cloned();
            session.set_held_shapes(BODY, shapes);
        }
    }

    pub(super) fn begin(&mut self, now: Duration) {
        self.measuring = Some(now);
        // Ticks without a new state count as missed from here on.
        if self.displayed_at.is_none() {
            self.displayed_at = Some(now);
        }
    }

    /// Counts the ticks that were still due when the measurement ended.
    pub(super) fn end(&mut self, now: Duration) {
        self.stand_still(now);
    }

    /// Counts the ticks that are due since the last shown tick as missed: one per step, with a
    /// tolerance of half a step. Each is compared with the last visual state.
    fn stand_still(&mut self, now: Duration) {
        let (Some(since), Some(_)) = (self.displayed_at, self.measuring) else { return };
        let due = (now.saturating_sub(since).as_secs_f64() / self.h - 0.5).max(0.0) as u64;
        while self.stalled < due {
            self.stalled += 1;
            self.miss(now, self.last_tick + self.stalled);
        }
    }

    /// The entry of the track for a tick: the first hand, along one axis, as it is shown.
    fn track_point(&self, tick: u64, truth: &Truth) -> TrackPoint {
        let (axis, hand) = (self.track_axis, &self.track_hand);
        let of_first =
            |all: &[(GrabKey, [f64; 3])]| all.iter().find(|r| r.0.grab == 0).map_or(0.0, |r| r.1[axis]);
        TrackPoint {
            tick,
            displacement: [hand.first(axis, &truth.picture), hand.first(axis, &self.picture)],
            reaction: [of_first(&truth.reactions), of_first(&self.played)],
        }
    }

    /// Counts one missed tick and compares the last visual state with the true state of that tick.
    fn miss(&mut self, now: Duration, tick: u64) {
        let first = self.truth.front().map_or(u64::MAX, |truth| truth.tick);
        let Some(truth) = tick.checked_sub(first).and_then(|i| self.truth.get(i as usize)) else { return };
        // A guest without any state shows the body at rest. Modes that it does not have count as 0.
        let (sum, largest) = self.shape.compare(&self.picture, &truth.picture);
        let motion = self.shape.size(&truth.picture).0;
        let forces = force_error(&truth.reactions, &self.played);
        let point = self.keep_track.then(|| self.track_point(tick, truth));
        self.track.extend(point);
        self.missing += 1;
        self.record(now, sum, motion, largest, forces);
    }

    /// Adds the squared errors of one tick, shown or missed: of the shape, with the squared true
    /// displacement, and of the reactions, see [`force_error`].
    fn record(&mut self, now: Duration, sum: f64, motion: f64, largest: f64, forces: (f64, f64, u64)) {
        self.force_sum += forces.0;
        self.force_motion += forces.1;
        self.force_count += forces.2;
        self.sum += sum;
        self.motion += motion;
        self.compared += 1;
        self.largest = self.largest.max(largest);
        self.last = largest;
        self.above.push((now, largest.sqrt()));
    }

    pub(super) fn metrics(&self, session: &GuestSession) -> Metrics {
        let percent = |x: f64, scale: f64| if scale > 0.0 { 100.0 * x / scale } else { 0.0 };
        let counts = session.body(BODY).map(|b| b.counts()).unwrap_or_default();
        let places = self.shape.places();
        let (ticks, compared) = (self.count.max(1) as f64, self.compared.max(1) as f64);
        let ratio = |a: f64, b: f64| if b > 0.0 { a / b } else { 0.0 };
        // Find the longest time for which the visual error stayed above the threshold.
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
        Metrics {
            ticks: self.count,
            missing: self.missing,
            guessed: counts.guessed,
            recovered: counts.repaired,
            rms_percent: percent((self.sum / compared / places).sqrt(), self.scale),
            rms_of_motion_percent: percent(self.sum.sqrt(), self.motion.sqrt()),
            max_percent: percent(self.largest.sqrt(), self.scale),
            end_percent: percent(self.last.sqrt(), self.scale),
            confirmed_end_percent: percent(self.confirmed_last.sqrt(), self.scale),
            force_rms_percent: percent(
                (self.force_sum / self.force_count.max(1) as f64).sqrt(),
                self.force_scale,
            ),
            force_rms_of_force_percent: percent(self.force_sum.sqrt(), self.force_motion.sqrt()),
            force_ringing: ratio(self.visual_second, self.force_scale),
            true_ringing: ratio(self.true_second, self.force_scale),
            hand_to_force_ms: if self.predict_hand {
                // The guest's own copy of the body answers, and nothing here measures when.
                f64::NAN
            } else {
                // A target leaves with the guest's tick and waits for the host's next step, half a
                // step on average. Then its reaction travels back and is shown.
                1e3 * (session.stats().round_trip.as_secs_f64() * 0.5 + 0.5 * self.h + delay)
            },
            visual_delay_ms: 1e3 * delay,
            recover_ms: longest.as_secs_f64() * 1e3,
            hash: self.hash,
            counts,
            scale: self.scale,
            force_scale: self.force_scale,
            track: self.track.clone(),
            ..Metrics::default()
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
                // Scripted hands are finite, so their targets are in range.
                let _ = self.body.set_target(id, std::array::from_fn(|k| start[k] + d[k]));
            }
        }
        // Where none can be made, the body goes on without.
        if self.held_shapes && self.body.make_held_shapes().is_err() {
            self.held_shapes = false;
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
                    hold: GrabConfig::default(),
                })
            })
            .collect();
        let pose = self.body.model().is_free().then(|| RigidState::of(&self.body));
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
        // A state that cannot be published shows up as ticks that never arrive.
        let _ = host.publish(now, BODY, &state);
        if self.truth.len() >= KEPT {
            self.truth.pop_front();
        }
        let picture = Picture { q: self.body.q().to_vec(), pose };
        if self.measuring.is_some() {
            let (_, largest) = self.shape.size(&picture);
            self.scale = self.scale.max(largest.sqrt());
            for g in &grabs {
                self.force_scale = self.force_scale.max(norm(g.reaction));
            }
        }
        self.truth.push_back(Truth {
            tick,
            at: now,
            picture,
            reactions: grabs.iter().map(|g| (g.key, g.reaction)).collect(),
        });
    }

    fn host_event(&mut self, _now: Duration, _event: HostEvent, _host: &mut HostSession) {}

    fn guest_stepped(&mut self, now: Duration, _guest: usize, _stepped: u64, session: &mut GuestSession) {
        self.hold_at_guest(now, session);
        self.shape_at_guest(session);
        let Some(view) = session.body(BODY) else { return self.stand_still(now) };
        let (Some(shown), Some(confirmed)) = (view.visual(), view.confirmed()) else {
            return self.stand_still(now);
        };
        let tick = view.tick();
        if tick <= self.last_tick {
            return self.stand_still(now);
        }
        if self.measuring.is_none() {
            (self.last_tick, self.displayed_at) = (tick, Some(now));
            self.picture = Picture { q: shown.q.clone(), pose: view.pose() };
            return;
        }
        // Ticks that a catch-up skips were never shown. The previous visual state stood in their
        // place.
        for passed in self.last_tick + self.stalled + 1..tick {
            self.miss(now, passed);
        }
        // Second differences need consecutive ticks. A stall followed by a catch-up counts in the
        // errors.
        self.in_row = if tick == self.last_tick + 1 { self.in_row + 1 } else { 0 };
        (self.last_tick, self.displayed_at, self.stalled) = (tick, Some(now), 0);
        self.picture = Picture { q: shown.q.clone(), pose: view.pose() };
        let Some(first) = self.truth.front().map(|t| t.tick) else { return };
        let Some(truth) = tick.checked_sub(first).and_then(|i| self.truth.get(i as usize)) else { return };
        let (sum, largest) = self.shape.compare(&self.picture, &truth.picture);
        // The session has no confirmed pose of a free body, only the shown one.
        let confirmed = Picture { q: confirmed.q.clone(), pose: view.pose() };
        let (_, confirmed_largest) = self.shape.compare(&confirmed, &truth.picture);
        let motion = self.shape.size(&truth.picture).0;
        let at = truth.at;
        self.played.clear();
        self.played.extend(view.grabs().iter().map(|g| (g.key, g.reaction)));
        let forces = force_error(&truth.reactions, &self.played);
        self.visual_force.resize(view.grabs().len().max(self.visual_force.len()), ([0.0; 3], [0.0; 3]));
        self.true_force.resize(self.visual_force.len(), ([0.0; 3], [0.0; 3]));
        for (i, g) in view.grabs().iter().enumerate() {
            let Some((_, reaction)) = truth.reactions.iter().find(|r| r.0 == g.key) else { continue };
            for (series, new, second) in [
                (&mut self.visual_force[i], g.reaction, &mut self.visual_second),
                (&mut self.true_force[i], *reaction, &mut self.true_second),
            ] {
                if self.in_row >= 2 {
                    let d = std::array::from_fn(|k| new[k] - 2.0 * series.1[k] + series.0[k]);
                    *second = second.max(norm(d));
                }
                *series = (series.1, new);
            }
        }
        let point = self.keep_track.then(|| self.track_point(tick, truth));
        self.track.extend(point);
        self.count += 1;
        self.confirmed_last = confirmed_largest;
        self.delay_sum += now.saturating_sub(at).as_secs_f64();
        self.record(now, sum, motion, largest, forces);
        self.hash = self.picture.fold(self.hash);
    }
}
