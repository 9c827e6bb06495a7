//! Load test: many guests in one process, each a complete session without an app.

use std::collections::BTreeSet;
use std::error::Error;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use pliant::modal::ModalModel;
use pliant::net::transport::{Carrier, Endpoint, Event, JoinOptions};
use pliant::net::{Emulation, Invite};
use pliant::stream::wire::Datagram;
use pliant::stream::{Channel, GuestEvent, GuestSession, GuestSessionConfig, PeerId, RecoveryConfig};

/// Settings of the bots.
pub struct Bots {
    pub number: usize,
    /// Number of bots that hold the body and move it.
    pub holders: usize,
    /// Whether bots that have joined only count frames and step no body, which leaves the processor
    /// to the host.
    pub light: bool,
    /// Whether the bots have the model, so that the host does not send it.
    pub cached: bool,
    pub seconds: f64,
    pub emulation: Option<Emulation>,
    /// Set to stop the bots early.
    pub stopped: Arc<AtomicBool>,
}

struct Bot {
    endpoint: Endpoint,
    session: Option<GuestSession>,
    began: Instant,
    /// Time from the start of the bot to the first ready body.
    joined: Option<Duration>,
    grab: Option<u16>,
    ticks: Ticks,
    bytes: u64,
    closed: Option<String>,
}

/// Number of ticks that a bot remembers, to count each once.
const REMEMBERED: usize = 1024;

/// The ticks that have arrived. A bot that runs for hours remembers the newest ones only.
#[derive(Default)]
struct Ticks {
    first: Option<u64>,
    count: u64,
    newest: BTreeSet<u64>,
}

impl Ticks {
    fn insert(&mut self, tick: u64) {
        // What is older than all that is remembered stays missing.
        let full = self.newest.len() >= REMEMBERED;
        if full && self.newest.first().is_some_and(|oldest| tick < *oldest) || !self.newest.insert(tick) {
            return;
        }
        self.first = Some(self.first.map_or(tick, |first| first.min(tick)));
        self.count += 1;
        if full {
            self.newest.pop_first();
        }
    }

    /// Ticks between the first and the newest one that never arrived.
    fn missing(&self) -> u64 {
        let span = self.first.zip(self.newest.last()).map_or(0, |(first, last)| last - first + 1);
        span - self.count
    }
}

pub fn run(invite: &Invite, model: &Arc<ModalModel>, bots: &Bots) -> Result<(), Box<dyn Error>> {
    let mut all = Vec::new();
    let start = Instant::now();
    for number in 0..bots.number {
        if bots.stopped.load(Ordering::Relaxed) {
            break;
        }
        let emulation = bots.emulation.clone().map(|e| Emulation { seed: e.seed + number as u64, ..e });
        let endpoint = Endpoint::join(invite, JoinOptions { emulation, ..JoinOptions::default() })?;
        all.push(Bot {
            endpoint,
            session: None,
            began: Instant::now(),
            joined: None,
            grab: None,
            ticks: Ticks::default(),
            bytes: 0,
            closed: None,
        });
        // The bots join one after another, 10 ms apart.
        let until = Instant::now() + Duration::from_millis(10);
        while Instant::now() < until {
            all.iter_mut().for_each(|bot| bot.turn(model, bots, start));
            std::thread::sleep(Duration::from_millis(2));
        }
    }
    println!("{} bots after {:.1} s", all.len(), start.elapsed().as_secs_f64());
    let mut reported = Instant::now();
    while start.elapsed().as_secs_f64() < bots.seconds && !bots.stopped.load(Ordering::Relaxed) {
        all.iter_mut().for_each(|bot| bot.turn(model, bots, start));
        std::thread::sleep(Duration::from_millis(2));
        if reported.elapsed().as_secs_f64() > 10.0 {
            reported = Instant::now();
            report(&all, start);
        }
    }
    report(&all, start);
    match all.iter().find_map(|bot| bot.closed.as_ref()) {
        Some(why) => Err(format!("a bot's session ended: {why}").into()),
        None if all.iter().any(|bot| bot.joined.is_none()) => Err("not all bots saw the body".into()),
        None => Ok(()),
    }
}

fn report(all: &[Bot], start: Instant) {
    let mut joins: Vec<f64> = all.iter().filter_map(|bot| Some(bot.joined?.as_secs_f64())).collect();
    joins.sort_by(f64::total_cmp);
    let median = joins.get(joins.len() / 2).copied().unwrap_or(0.0);
    let missing: u64 = all.iter().map(|bot| bot.ticks.missing()).sum();
    let received: u64 = all.iter().map(|bot| bot.ticks.count).sum();
    let (guessed, repaired) =
        all.iter().filter_map(|bot| bot.session.as_ref()).fold((0, 0), |sum, session| {
            session.bodies().fold(sum, |(g, r), view| (g + view.counts().guessed, r + view.counts().repaired))
        });
    println!(
        "{:5.1} s  {} bots in, joined in {median:.2} s in the median and {:.2} at most; {received} ticks received, {missing} missing, {:.1} kbit/s each, \
         guessed {guessed} corrected {repaired}",
        start.elapsed().as_secs_f64(),
        joins.len(),
        joins.last().copied().unwrap_or(0.0),
        all.iter().map(|bot| bot.bytes).sum::<u64>() as f64 * 8e-3
            / all.len().max(1) as f64
            / start.elapsed().as_secs_f64(),
    );
}

impl Bot {
    fn turn(&mut self, model: &Arc<ModalModel>, bots: &Bots, start: Instant) {
        while let Some(event) = self.endpoint.poll() {
            let now = self.began.elapsed();
            match event {
                Event::Connected { .. } => {
                    let most = self.endpoint.max_datagram_size(PeerId::HOST).unwrap_or(0);
                    let config = GuestSessionConfig {
                        name: "bot".into(),
                        recovery: RecoveryConfig::default(),
                        ..Default::default()
                    };
                    let Ok(mut session) = GuestSession::new(config, most) else { return };
                    if bots.cached {
                        session.add_cached_model(model.clone());
                    }
                    session.connect(now).ok();
                    self.session = Some(session);
                }
                Event::Datagram { at, bytes, .. } => {
                    self.bytes += bytes.len() as u64;
                    let decoded = Datagram::decode(&bytes);
                    if let Ok((_, Datagram::Frame(frame))) = &decoded {
                        self.ticks.insert(frame.tick);
                        for repeat in &frame.repeats {
                            self.ticks.insert(frame.tick.saturating_sub(u64::from(repeat.back)));
                        }
                        if bots.light && self.joined.is_some() {
                            continue;
                        }
                    }
                    if let Some(session) = &mut self.session {
                        session.on_datagram(at.saturating_duration_since(self.began), &bytes);
                    }
                }
                Event::Message { bytes, .. } => {
                    self.bytes += bytes.len() as u64;
                    if let Some(session) = &mut self.session {
                        session.on_message(now, &bytes);
                    }
                }
                Event::Closed { reason, .. } => self.closed = Some(reason.to_string()),
                _ => {}
            }
        }
        let now = self.began.elapsed();
        let Some(session) = &mut self.session else { return };
        session.update(now);
        while let Some(event) = session.poll_event() {
            if let GuestEvent::BodyReady { body, .. } = event {
                self.joined.get_or_insert(now);
                // Users are numbered from 1 in the order in which they join.
                let holds = session.user().is_some_and(|user| usize::from(user.0) <= bots.holders);
                if holds && !bots.light {
                    let positions = model.surface().positions();
                    let vertex = (positions.len() / (bots.holders + 1)) as u32
                        * u32::from(session.user().map_or(1, |u| u.0));
                    let at = positions.get(vertex as usize).map_or([0.0; 3], |p| p.map(f64::from));
                    self.grab = session
                        .begin_grab(now, body, vertex, 0.06 * model.size(), at, Default::default())
                        .ok();
                }
            }
        }
        if let Some(grab) = self.grab {
            let t = start.elapsed().as_secs_f64();
            let size = model.size();
            session.set_target(grab, [0.1 * size * t.sin(), 0.5 * size, 0.1 * size * (1.3 * t).cos()]).ok();
        }
        while let Some(output) = session.poll_output() {
            match output.channel {
                Channel::Datagram => {
                    self.endpoint.send_datagram(PeerId::HOST, Bytes::from_owner(output.bytes)).ok();
                }
                Channel::Message => {
                    self.endpoint.send_message(PeerId::HOST, Bytes::from_owner(output.bytes)).ok();
                }
            }
        }
    }
}
