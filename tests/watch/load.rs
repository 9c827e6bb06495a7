//! Many watchers of one session in one process: what each hears and misses, how late it comes, and
//! what other processes (the relay, the host) cost meanwhile. `tests/watch/load.sh` runs it.
//!
//! ```sh
//! watch_load RELAY CERTIFICATE SESSION BODY.modal WATCHERS SECONDS [NAME=PID...]
//! ```
//!
//! CERTIFICATE is the hash of the relays' certificate, or `system` for what the system trusts. With
//! MODELS=fetch in the environment every watcher fetches the model; otherwise they have it.
//!
//! Prints a line of JSON. The delay of a frame is how much later it arrived than the fastest frame
//! of the run would have; the delay of that fastest frame itself is not known. A frame counts as
//! missing for a watcher that received an earlier frame and a later one, but not this one. If a
//! watcher received nothing in the last second of the run, all frames after its last one count as
//! missing, too. Bytes and packets are all that crossed loopback, so run the program in a network
//! namespace of its own if other programs use loopback.
#![allow(missing_docs, reason = "a program for measurements")]

#[path = "../../examples/session/mod.rs"]
mod session;

use std::collections::BTreeMap;
use std::error::Error;
use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use pliant::net::watch::{RelayOptions, WatchEvent, Watcher};

/// Watchers on a thread. Each has a connection and a socket of its own.
const A_THREAD: usize = 50;

/// What one watcher hears.
#[derive(Default)]
struct Heard {
    first_picture: Option<Duration>,
    /// When the last frame came, and the longest time between two within the measured time.
    before: Option<Instant>,
    silence: Duration,
    /// First and last tick within the measured time, and the number of those heard.
    first: u64,
    last: u64,
    count: u64,
    wrong: u64,
    over: u64,
}

/// Bytes and packets that have crossed loopback so far.
fn loopback() -> [u64; 2] {
    let text = std::fs::read_to_string("/proc/net/dev").unwrap_or_default();
    let line = text.lines().find_map(|line| line.trim().strip_prefix("lo:"));
    let mut counts = line.unwrap_or_default().split_whitespace().map(|count| count.parse().unwrap_or(0));
    [counts.next().unwrap_or(0), counts.next().unwrap_or(0)]
}

fn main() -> Result<(), Box<dyn Error>> {
    let given: Vec<String> = std::env::args().skip(1).collect();
    let [relays, certificate, name, body, watchers, seconds, processes @ ..] = &given[..] else {
        return Err("expected RELAY,.. CERTIFICATE SESSION BODY WATCHERS SECONDS [NAME=PID...]".into());
    };
    // What all watchers cost themselves is told beside the rest.
    let processes: Vec<&str> = processes.iter().map(String::as_str).chain(["watchers=self"]).collect();
    let (watchers, seconds): (usize, f64) = (watchers.parse()?, seconds.parse()?);
    let model = session::model(Path::new(body))?;
    let fetch = std::env::var("MODELS").is_ok_and(|models| models == "fetch");
    let known = if fetch { Vec::new() } else { vec![model] };
    let relays: Vec<&str> = relays.split(',').collect();
    let began = Instant::now();
    let mut followed = Vec::new();
    let options = relays.iter().map(|relay| match certificate.as_str() {
        "system" => Ok(RelayOptions::new(*relay, name)),
        hash => RelayOptions::new(*relay, name).with_certificate(hash).ok_or("CERTIFICATE is no hash"),
    });
    let options = options.collect::<Result<Vec<_>, _>>()?;
    let all: Vec<RelayOptions> = options.iter().cycle().take(watchers).cloned().collect();
    for some in all.chunks(A_THREAD) {
        let opened = Instant::now();
        let watchers = Watcher::open_all(some, known.clone())?;
        followed.extend(watchers.into_iter().map(|watcher| (opened, watcher, Heard::default())));
        // Not all handshakes in one moment.
        sleep(Duration::from_millis(5 * some.len() as u64));
    }
    let (mut step, mut every) = (0.0, 1);
    // A few seconds until everybody has the first picture, then the measured time.
    let mut measured: Option<(Instant, BTreeMap<&str, (f64, f64)>, [u64; 2])> = None;
    let mut late: Vec<f64> = Vec::new();
    loop {
        let now = Instant::now();
        if let Some((since, ..)) = &measured
            && (now - *since).as_secs_f64() > seconds
        {
            break;
        }
        let mut idle = true;
        for (opened, watcher, heard) in &mut followed {
            while let Some(event) = watcher.poll() {
                idle = false;
                match event {
                    WatchEvent::Catalog(catalog) => {
                        step = catalog.step;
                        every = catalog.bodies.first().map_or(1, |body| u64::from(body.every));
                    }
                    WatchEvent::State(_, state) => {
                        heard.first_picture.get_or_insert(opened.elapsed());
                        if measured.is_some() {
                            let came = Instant::now();
                            let silent =
                                heard.before.replace(came).map_or(Duration::ZERO, |before| came - before);
                            heard.silence = heard.silence.max(silent);
                            if heard.count == 0 {
                                heard.first = state.tick;
                            }
                            heard.last = heard.last.max(state.tick);
                            heard.count += 1;
                            late.push(began.elapsed().as_secs_f64() - state.tick as f64 * step);
                        }
                    }
                    WatchEvent::Wrong(_) => heard.wrong += 1,
                    WatchEvent::Over => heard.over += 1,
                    _ => {}
                }
            }
        }
        let all = followed.iter().all(|(_, _, heard)| heard.first_picture.is_some());
        if measured.is_none() && (all || began.elapsed() > Duration::from_secs(90)) {
            let used = processes.iter().filter_map(|one| {
                let (name, pid) = one.split_once('=')?;
                Some((name, session::used_by(pid)?))
            });
            measured = Some((now, used.collect(), loopback()));
            eprintln!("measuring");
        }
        if idle {
            sleep(Duration::from_millis(1));
        }
    }
    let Some((since, before, crossed)) = measured else { return Err("nothing was measured".into()) };
    let passed = since.elapsed().as_secs_f64();
    let [bytes, packets] = [0, 1].map(|k| (loopback()[k] - crossed[k]) as f64 / passed);
    late.sort_by(f64::total_cmp);
    let part = |of: &[f64], share: f64| of.get((of.len() as f64 * share) as usize).copied().unwrap_or(0.0);
    let earliest = late.first().copied().unwrap_or(0.0);
    let mut pictures: Vec<f64> =
        followed.iter().filter_map(|(_, _, heard)| Some(heard.first_picture?.as_secs_f64())).collect();
    pictures.sort_by(f64::total_cmp);
    let heard: u64 = followed.iter().map(|(_, _, heard)| heard.count).sum();
    let all = followed.iter().map(|(_, _, heard)| heard);
    let newest = all.clone().map(|heard| heard.last).max().unwrap_or(0);
    let oldest = all.clone().filter(|heard| heard.count > 0).map(|heard| heard.first).min().unwrap_or(0);
    let due = |heard: &Heard| {
        let first = if heard.count > 0 { heard.first } else { oldest };
        let silent = (newest - heard.last) as f64 * step > 1.0;
        (if silent { newest } else { heard.last }).saturating_sub(first) / every + 1
    };
    let missing: u64 = all.map(|heard| due(heard).saturating_sub(heard.count)).sum();
    let mut costs = String::new();
    for one in &processes {
        let Some((name, pid)) = one.split_once('=') else { continue };
        if let (Some((then, memory_then)), Some((now, memory))) = (before.get(name), session::used_by(pid)) {
            let share = 100.0 * (now - then) / passed;
            costs.push_str(&format!(
                ",\"{name}\":{{\"processor_percent\":{share:.1},\"memory_mb\":[{memory_then:.0},{memory:.0}]}}"
            ));
        }
    }
    println!(
        "{{\"watchers\":{watchers},\"with_picture\":{},\"first_picture_s\":[{:.2},{:.2}],\"seconds\":{passed:.1},\
         \"heard\":{heard},\"missing\":{missing},\"delay_ms\":[{:.1},{:.1}],\"silence_s\":{:.2},\"wrong\":{},\"over\":{},\
         \"bytes_per_s\":{bytes:.0},\"packets_per_s\":{packets:.0}{costs}}}",
        pictures.len(),
        part(&pictures, 0.5),
        pictures.last().copied().unwrap_or(0.0),
        1e3 * (part(&late, 0.5) - earliest),
        1e3 * (part(&late, 0.99) - earliest),
        followed.iter().map(|(_, _, heard)| heard.silence.as_secs_f64()).fold(0.0, f64::max),
        followed.iter().map(|(_, _, heard)| heard.wrong).sum::<u64>(),
        followed.iter().map(|(_, _, heard)| heard.over).sum::<u64>(),
    );
    Ok(())
}
