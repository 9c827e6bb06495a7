//! Hitches are not kicks: a host or a guest that stalls comes back smoothly, and a reaction that
//! cannot be known fades. One session is that of the example `shared_body`: Pip, held by two guests
//! that pull, let go and take hold again. In the other, a guest leads the tip of a bar in a circle.
//!
//! The measure of a reaction that is shown to a hand is the largest one that the body gave to this
//! hand within the last second. A prediction is ahead of the host by the way there, so that what
//! the host makes of the same target counts too: the last second begins one second before the
//! reaction is shown, and ends six ticks after the host has played the target that the hand then
//! has.

use crate::support;

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use pliant_lab::pair::{PathConfig, World};
use pliant_modal::{GrabConfig, ModalModel};
use pliant_stream::emulator::{LinkConfig, Preset};
use pliant_stream::{
    GrabKey, GuestEvent, GuestSession, GuestSessionConfig, HandPlayout, HostEvent, HostSession, UserId,
};
use support::bar;
use support::scene::{BODY, MS, S, Scene, cached, start};

/// The hands have settled by then.
const SETTLED: Duration = Duration::from_secs(5);
/// A host plays a guest's targets back, and limits the speed of the hand to twenty body sizes a
/// second. Six ticks after a jump, a twentieth of it is left.
const DELAY: usize = 2;
const FADED: usize = 6;
const SPEED: f64 = 20.0 / 40.0;

/// Largest reaction that may be shown, as a share of the largest one that the body gave within the
/// last second: a fifth beyond it, and the rounding of the frames.
const MAX_SHOWN: f64 = 1.2 + 1e-4;
/// For so long after a stall, what is shown counts as shown after a hitch. What is shown later is
/// printed beside it, and so is what is shown before the host has told of the hand: a hand that
/// takes hold of a body that swings is not predicted well, with hitches or without.
const AFTER: Duration = Duration::from_millis(1500);

/// The shape is back when it is off by no more than this share of the largest shape for a tenth of
/// a second, and the time that this may take after a stall: half a second, and a tick, since the
/// shape is looked at once a tick. Frames that the network loses afterwards
/// cost what they cost without stalls too.
const BACK: f64 = 0.01;
const BACK_FOR: Duration = Duration::from_millis(100);
const BACK_WITHIN: Duration = Duration::from_millis(525);

/// For so long after a tick that was guessed, an error is what the network's losses cost: two
/// frames that are lost in a row cost 1 %. Largest share of such ticks.
const LOST_FOR: Duration = Duration::from_millis(200);
const MAX_LOST: f64 = 0.1;

/// How far the true reactions of sessions with stalls may exceed those of sessions without: a hand
/// that is late is led back at the speed of a hand.
const MAX_TRUE: f64 = 1.6;

/// A reaction that is shown to a guest's hand.
struct Shown {
    at: Duration,
    /// Number of the hand's present target.
    input: u32,
    force: f64,
    /// Whether the host has told of the hand. Before, nothing is known of how it took hold.
    known: bool,
}

/// What the body gives to a guest's hand at a tick.
struct Given {
    at: Duration,
    /// Number of the last target that the host has played.
    input: u32,
    force: f64,
}

/// What a guest showed.
#[derive(Default)]
struct Seen {
    shown: Vec<Shown>,
    /// The time, the error of the shown shape, and whether a tick was guessed shortly before.
    off: Vec<(Duration, f64, bool)>,
    /// The number of ticks that were guessed, and when it last grew.
    guessed: (u64, Duration),
}

struct Hitched {
    scene: Scene,
    hands: Vec<Hand>,
    /// What the hands hold: the number of the newest target that has come, and how it is played.
    held: BTreeMap<GrabKey, (u32, HandPlayout)>,
    given: Vec<Vec<Given>>,
    seen: Vec<Seen>,
    /// The farthest that a hand may move in a tick, m.
    most: f64,
    /// The largest level at which the host has cut a guest's stream.
    level: u8,
}

fn norm(x: [f64; 3]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

impl World for Hitched {
    fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession) {
        for (key, id, ..) in &self.scene.grabs {
            let Some((_, hand)) = self.held.get_mut(key) else { continue };
            self.scene.body.set_target(*id, hand.next(DELAY, self.most).into()).unwrap();
        }
        self.scene.step(now, tick, host);
        let levels = host.users().filter_map(|(peer, ..)| host.stats(peer)).map(|stats| stats.level);
        self.level = levels.fold(self.level, u8::max);
        for (guest, given) in self.given.iter_mut().enumerate() {
            let now_held = self.held.iter().find(|(key, _)| self.hands[guest].key == Some(**key));
            let input = now_held.map(|(_, (newest, hand))| newest - hand.waiting() as u32);
            let last = given.last().map_or(0, |given| given.input);
            let own = self.scene.reactions.iter().rev().take_while(|r| r.0 == tick);
            let own = own.filter(|r| self.hands[guest].user == Some(r.1.user));
            let force = own.map(|r| norm(r.2)).fold(0.0, f64::max);
            given.push(Given { at: now, input: input.unwrap_or(last).max(last), force });
        }
    }

    fn host_event(&mut self, now: Duration, event: HostEvent, host: &mut HostSession) {
        match event {
            HostEvent::GrabMoved { key, input, target, .. } => {
                if let Some((newest, hand)) = self.held.get_mut(&key) {
                    hand.take(input, 1, target.into());
                    *newest = input;
                }
                return;
            }
            HostEvent::GrabBegan { key, target, .. } => {
                let first = self.hands.iter().find(|hand| hand.key == Some(key)).map_or(0, |hand| hand.first);
                self.held.insert(key, (first, HandPlayout::new(target.into())));
            }
            HostEvent::GrabEnded { key, .. } => {
                self.held.remove(&key);
                // What has not been played of this grab never is.
                let mut guests = self.hands.iter().zip(&mut self.given);
                if let Some((hand, given)) = guests.find(|(hand, _)| hand.user == Some(key.user))
                    && let Some(last) = given.last_mut()
                {
                    last.input = hand.input;
                }
            }
            _ => {}
        }
        self.scene.host_event(now, event, host);
    }

    fn guest_event(&mut self, now: Duration, guest: usize, event: GuestEvent, s: &mut GuestSession) {
        self.scene.guest_event(now, guest, event, s);
    }

    fn guest_stepped(&mut self, now: Duration, guest: usize, stepped: u64, session: &mut GuestSession) {
        let Some(user) = session.user() else { return };
        let hand = &mut self.hands[guest];
        if stepped > 0 {
            hand.play(now, user, session);
        }
        let Some(view) = session.body(BODY).filter(|view| view.is_ready() && now > SETTLED) else { return };
        let seen = &mut self.seen[guest];
        if let Some(key) = hand.key
            && let Some(force) = view.hand_reaction(user, key.grab)
        {
            let known = view.grabs().iter().any(|grab| grab.key == key);
            seen.shown.push(Shown { at: now, input: hand.input, force: norm(force), known });
        }
        // A guest whose host stalls goes on for some ticks that the host has yet to make.
        let made = self.scene.truth.last().is_some_and(|(tick, _)| view.tick() <= *tick);
        let guessed = view.counts().guessed;
        if guessed > seen.guessed.0 {
            seen.guessed = (guessed, now);
        }
        if stepped > 0 && made {
            let lost = now < seen.guessed.1 + LOST_FOR;
            seen.off.push((now, self.scene.error(session), lost));
        }
    }
}

/// A hand of a guest.
struct Hand {
    vertex: u32,
    radius: f64,
    /// Time at which it first takes hold, and how long it holds of every five and a half seconds,
    /// s.
    begins: f64,
    holds: f64,
    /// Its target after so many seconds, m.
    path: Box<dyn Fn(f64) -> [f64; 3]>,
    began: f64,
    user: Option<UserId>,
    /// What it holds.
    key: Option<GrabKey>,
    /// Number of its present target, and of the one with which it took hold.
    input: u32,
    first: u32,
}

impl Hand {
    fn new(vertex: u32, radius: f64, path: impl Fn(f64) -> [f64; 3] + 'static) -> Self {
        let path = Box::new(path);
        let (begins, holds, began) = (0.0, f64::INFINITY, 0.0);
        Self { vertex, radius, begins, holds, path, began, user: None, key: None, input: 0, first: 0 }
    }

    /// A hand of `shared_body`: it takes hold of the farthest vertex in its direction, pulls, lets
    /// go for a second, and begins again.
    fn pulling(model: &ModalModel, toward: [f64; 3], pull: [f64; 3], begins: f64) -> Self {
        let (positions, size) = (model.surface().positions(), model.size());
        let along = |vertex: usize| (0..3).map(|k| f64::from(positions[vertex][k]) * toward[k]).sum::<f64>();
        let vertex = (0..positions.len()).max_by(|&a, &b| along(a).total_cmp(&along(b))).unwrap();
        let rest = positions[vertex].map(f64::from);
        let path = move |t: f64| {
            let ramp = (t / 0.8).clamp(0.0, 1.0);
            let smooth = ramp * ramp * ramp * (10.0 - 15.0 * ramp + 6.0 * ramp * ramp);
            let wave = |rate: f64, shift: f64| 0.2 * ((rate * t + shift).sin() - shift.sin());
            let aside = [wave(2.1, 0.0), wave(2.9, 0.8), wave(1.7, 1.9)];
            std::array::from_fn(|k| rest[k] + size * smooth * (pull[k] + aside[k] * norm(pull)))
        };
        Self { begins, holds: 4.5, ..Self::new(vertex as u32, 0.06 * size, path) }
    }

    fn play(&mut self, now: Duration, user: UserId, session: &mut GuestSession) {
        let since = now.as_secs_f64() - self.begins;
        let phase = since % 5.5;
        self.user = Some(user);
        match self.key {
            _ if since < 0.0 => {}
            Some(key) if phase > self.holds => {
                session.end_grab(key.grab);
                self.key = None;
            }
            Some(key) => {
                session.set_target(key.grab, (self.path)(since - self.began)).unwrap();
                self.input += 1;
            }
            None if phase < 0.5 * self.holds => {
                let (target, hold) = ((self.path)(0.0), GrabConfig::default());
                let grab = session.begin_grab(now, BODY, self.vertex, self.radius, target, hold);
                self.key = grab.ok().map(|grab| GrabKey { user, grab });
                (self.began, self.first) = (since, self.input);
            }
            None => {}
        }
    }
}

/// A body and the guests' hands on it.
#[derive(Debug, Clone, Copy)]
enum Play {
    SharedBody,
    Circle,
}

impl Play {
    fn model(self) -> Arc<ModalModel> {
        match self {
            Self::SharedBody => {
                let pip = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal");
                Arc::new(ModalModel::read(pip).unwrap())
            }
            Self::Circle => bar(40, 0.05),
        }
    }

    fn hands(self, model: &ModalModel) -> Vec<Hand> {
        match self {
            Self::SharedBody => vec![
                Hand::pulling(model, [1.0, 0.55, 0.0], [0.18, 0.06, 0.13], 1.7),
                Hand::pulling(model, [-1.0, 0.55, 0.0], [-0.17, 0.08, 0.07], 1.0),
            ],
            Self::Circle => vec![Hand::new(66, 0.05, |t| {
                [1.0, 0.08 + 0.1 * (1.3 * t).sin(), 0.08 + 0.1 * (1.0 - (1.3 * t).cos())]
            })],
        }
    }

    /// Whether the shape stays within 1 % from half a second after a stall on. Where hands come and
    /// go, a lost frame costs more.
    fn stays(self) -> bool {
        matches!(self, Self::Circle)
    }
}

/// Who stalls.
#[derive(Debug, Clone, Copy)]
enum Who {
    Host,
    Guest,
    Both,
    Nobody,
}

/// A time from which on something stands still, and until when.
type Stall = (Duration, Duration);

struct Outcome {
    /// Largest reaction shown after a hitch and otherwise, over the largest one that the body gave
    /// within the last second.
    shown: [f64; 2],
    /// Largest reaction that was shown at any time, N, and that the body gave.
    most: f64,
    truth: f64,
    /// Longest time after a stall until the shape was back.
    back: Duration,
    /// Largest error of the shown shape from half a second after a stall on, as a share of the
    /// largest shape, where nothing was lost shortly before.
    off: f64,
    /// Number of looks at the shape, and of those at which something was lost shortly before.
    looks: usize,
    lost: usize,
    /// The largest level at which the host has cut a guest's stream.
    level: u8,
}

/// Stalls of 0.05 to 1 s that come at every one to four seconds.
fn stalls(seed: u64, lasts: Duration) -> Vec<Stall> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut random = |from: u64, to: u64| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        Duration::from_millis(from + state % (to - from))
    };
    let mut stalls = Vec::new();
    let mut end = SETTLED;
    while end < lasts {
        let begin = end + random(1000, 4000);
        end = begin + random(50, 1000);
        stalls.push((begin, end));
    }
    stalls
}

fn session(play: Play, model: &Arc<ModalModel>, who: Who, seed: u64, lasts: Duration) -> Outcome {
    let (mut pair, scene) = start(model);
    let (hands, most) = (play.hands(model), SPEED * model.size());
    let count = hands.len();
    let given = std::iter::repeat_with(Vec::new).take(count).collect();
    let seen = std::iter::repeat_with(Seen::default).take(count).collect();
    let mut world = Hitched { scene, hands, held: BTreeMap::new(), given, seen, most, level: 0 };
    let path = PathConfig::symmetric(LinkConfig::preset(Preset::Paper2));
    for guest in 0..count as u64 {
        let (config, seed) = (GuestSessionConfig::default(), 2 * seed + guest);
        pair.join_with(config, path.clone(), seed, cached(model)).unwrap();
    }
    // The stalls of the host, and those of each guest. Without any, the same times are looked at.
    let mut all: Vec<Vec<Stall>> = (0..=count as u64).map(|k| stalls(3 * seed + k, lasts)).collect();
    match who {
        Who::Host => all[1..].iter_mut().for_each(Vec::clear),
        Who::Guest => all[0].clear(),
        Who::Both | Who::Nobody => {}
    }
    let each = all.iter().enumerate().filter(|_| !matches!(who, Who::Nobody));
    let mut changes: Vec<(Duration, usize, bool)> =
        each.flat_map(|(k, all)| all.iter().flat_map(move |s| [(s.0, k, true), (s.1, k, false)])).collect();
    changes.sort();
    for (at, process, on) in changes {
        pair.run_until(at, &mut world);
        match process {
            0 => pair.stall_host(on),
            guest => pair.stall_guest(guest - 1, on),
        }
    }
    pair.run_until(pair.now().max(lasts), &mut world);

    let (back, level) = (Duration::ZERO, world.level);
    let mut outcome =
        Outcome { shown: [0.0; 2], most: 0.0, truth: 0.0, back, off: 0.0, looks: 0, lost: 0, level };
    let size = world.scene.size();
    for (guest, seen) in world.seen.iter().enumerate() {
        // The host and this guest stand still by turns, or both at once.
        let mut own: Vec<Stall> = Vec::new();
        let mut both = [&all[0][..], &all[1 + guest]].concat();
        both.sort();
        for stall in both {
            match own.last_mut() {
                Some(last) if stall.0 <= last.1 => last.1 = last.1.max(stall.1),
                _ => own.push(stall),
            }
        }
        let given = &world.given[guest];
        outcome.truth = given.iter().map(|g| g.force).fold(outcome.truth, f64::max);
        let played = given.last().map_or(0, |given| given.input);
        // What the host has not played when the session ends is compared with nothing.
        let ends = given.last().map_or(Duration::ZERO, |given| given.at.saturating_sub(2 * S));
        for shown in seen.shown.iter().filter(|shown| shown.input <= played || shown.at < ends) {
            let from = given.partition_point(|g| g.at + S < shown.at);
            let to = given.partition_point(|g| g.at <= shown.at || g.input < shown.input) + 1 + FADED;
            let to = to.min(given.len());
            let most = given[from.min(to)..to].iter().map(|g| g.force).fold(0.0, f64::max);
            let hitch = shown.known && own.iter().any(|s| s.0 <= shown.at && shown.at < s.1 + AFTER);
            let ratio = shown.force / most.max(0.01);
            outcome.most = outcome.most.max(shown.force);
            let worst = &mut outcome.shown[usize::from(!hitch)];
            *worst = worst.max(ratio);
        }
        let calm = |at: Duration| {
            let last = own.iter().rev().find(|stall| stall.1 <= at);
            let next = own.iter().find(|stall| stall.1 > at);
            last.is_some_and(|last| at > last.1 + 500 * MS) && next.is_none_or(|next| at < next.0)
        };
        let looks = || seen.off.iter().filter(|o| calm(o.0));
        outcome.looks += looks().count();
        outcome.lost += looks().filter(|o| o.2).count();
        outcome.off = looks().filter(|o| !o.2).map(|o| o.1 / size).fold(outcome.off, f64::max);
        let back = own.iter().enumerate().filter_map(|(k, &(_, stall))| {
            let until = own.get(k + 1)?.0;
            let from = seen.off.partition_point(|o| o.0 < stall);
            let to = seen.off.partition_point(|o| o.0 < until);
            let mut since = stall;
            // Where nothing that the host has made is shown, the shape is not back.
            let mut last = Duration::ZERO;
            for (at, off, _) in seen.off.get(from..to)? {
                if *off > BACK * size || *at > last + BACK_FOR {
                    since = *at;
                }
                last = *at;
                if *off <= BACK * size && *at >= since + BACK_FOR {
                    return Some(since - stall);
                }
            }
            // The next stall comes before a tenth of a second has passed.
            (until > stall + BACK_WITHIN + BACK_FOR).then(|| since.max(stall) - stall)
        });
        outcome.back = back.max().unwrap_or_default().max(outcome.back);
    }
    assert_eq!(pair.host.users().count(), count);
    outcome
}

/// Prints and returns the worst of some seeds.
fn worst(play: Play, who: Who, seeds: &Range<u64>, lasts: Duration) -> Outcome {
    let model = play.model();
    let all: Vec<Outcome> = seeds.clone().map(|seed| session(play, &model, who, seed, lasts)).collect();
    let largest = |of: fn(&Outcome) -> f64| all.iter().map(of).fold(0.0, f64::max);
    let shown = [largest(|o| o.shown[0]), largest(|o| o.shown[1])];
    let (truth, off) = (largest(|o| o.truth), largest(|o| o.off));
    let most = largest(|o| o.most / o.truth);
    let back = all.iter().map(|o| o.back).max().unwrap_or_default();
    let [looks, lost] =
        [|o: &Outcome| o.looks, |o: &Outcome| o.lost].map(|of| all.iter().map(of).sum::<usize>());
    let level = all.iter().map(|o| o.level).max().unwrap_or_default();
    let share = lost as f64 / looks.max(1) as f64;
    assert!(share <= MAX_LOST, "{play:?}, {who:?}: {share:.3} of the ticks are near a guessed one");
    let shares = all.iter().map(|o| o.lost as f64 / o.looks.max(1) as f64);
    let worst = shares.fold(0.0, f64::max);
    assert!(worst <= MAX_LOST, "{play:?}, {who:?}: {worst:.3} of a session's ticks");
    println!(
        "{play:?}, {who:?}: sessions {seeds:?} of {lasts:?}: largest reaction shown over largest true one of the \
         last second {:.3} after a hitch and {:.3} otherwise, largest shown over largest true one of a \
         session {most:.3} (true {truth:.2} N), shape within 1 % after {back:.0?}, off by {:.2} % at worst \
         from half a second after a stall on, {:.1} % of the looks near a guess ({:.1} % of a session's), \
         level {level}",
        shown[0],
        shown[1],
        100.0 * off,
        100.0 * share,
        100.0 * worst
    );
    Outcome { shown, most, truth, back, off, looks, lost, level }
}

/// Fails where stalls are felt, or seen for longer than half a second.
fn check(seeds: &Range<u64>, lasts: Duration) {
    let mut wrong = Vec::new();
    for play in [Play::SharedBody, Play::Circle] {
        let calm = worst(play, Who::Nobody, seeds, lasts);
        for who in [Who::Host, Who::Guest, Who::Both] {
            let Outcome { shown, most, truth, back, off, level, .. } = worst(play, who, seeds, lasts);
            for (is_wrong, what) in [
                (shown[0] > MAX_SHOWN, format!("shown {:.3} of the true reaction", shown[0])),
                (most > MAX_SHOWN, format!("at most {most:.3} of the largest true reaction")),
                (truth > MAX_TRUE * calm.truth, format!("true {truth:.2} N, {:.2} N without", calm.truth)),
                (back > BACK_WITHIN, format!("the shape is back after {back:?}")),
                (level > 0, format!("a stream is cut to level {level}, as if the path were congested")),
                (off > BACK && play.stays(), format!("the shape is off by {:.2} % afterwards", 100.0 * off)),
            ] {
                if is_wrong {
                    wrong.push(format!("{play:?}, {who:?}: {what}"));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn hitches_are_not_kicks() {
    check(&(1..11), 30 * S);
}

/// The same at length, run by hand: `PLIANT_HITCHES_SEEDS` (default 100) seeds from
/// `PLIANT_HITCHES_FROM` (default 1) on.
#[test]
#[ignore = "takes minutes"]
fn a_hundred_sessions_of_hitches_are_not_kicks() {
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse().ok());
    let [from, seeds] = ["PLIANT_HITCHES_FROM", "PLIANT_HITCHES_SEEDS"].map(number);
    let from = from.unwrap_or(1);
    check(&(from..from + seeds.unwrap_or(100)), 60 * S);
}
