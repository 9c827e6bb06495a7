//! Trace files of what the host computed and what a guest showed, tick by tick.
//!
//! The files can be compared after both runs have ended, wherever they ran. A record has these
//! fields:
//!
//! - `u64` tick.
//! - `u16` user. In the host's file, the host's id marks the true state, and a user's id marks the
//!   true state with that user's reaction. In a guest's file, the host's id marks the streamed
//!   body, and the guest's own id marks the body with its predicted hand.
//! - 3 x `f32` reaction on that user's hand, N; NaN without a hand.
//! - `u16` number of modes.
//! - One `f32` per mode, the modal coordinates.

use std::collections::BTreeMap;
use std::error::Error;
use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Write};
use std::path::Path;

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant::modal::ModalModel;
use pliant::net::{HandOf, NetGuest, RemoteBody, SharedBody, User};
use pliant::prelude::*;
use pliant::stream::UserId;

/// The trace file that is written.
#[derive(Resource)]
pub struct Trace {
    file: BufWriter<File>,
    last: u64,
    last_held: u64,
}

impl Trace {
    pub fn create(path: &Path) -> Result<Self, Box<dyn Error>> {
        let file = File::create(path).map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(Self { file: BufWriter::new(file), last: 0, last_held: 0 })
    }

    fn put(&mut self, tick: u64, user: UserId, reaction: Option<DVec3>, q: &[f64]) -> std::io::Result<()> {
        let file = &mut self.file;
        file.write_all(&tick.to_le_bytes())?;
        file.write_all(&user.0.to_le_bytes())?;
        let reaction = reaction.map_or([f32::NAN; 3], |force| force.as_vec3().to_array());
        reaction.iter().try_for_each(|x| file.write_all(&x.to_le_bytes()))?;
        file.write_all(&(q.len() as u16).to_le_bytes())?;
        q.iter().try_for_each(|x| file.write_all(&(*x as f32).to_le_bytes()))
    }
}

/// Writes the true state after each step of the host: once, and once more for every user's hand.
pub fn write_truth(
    trace: Option<ResMut<Trace>>,
    tick: Res<PliantTick>,
    bodies: Query<&BodyState, With<SharedBody>>,
    hands: Query<(&GrabForce, &HandOf)>,
    users: Query<&User>,
) {
    let Some(mut trace) = trace else { return };
    for state in &bodies {
        let q = state.body().q();
        let mut written = trace.put(tick.0, UserId::HOST, None, q);
        for (grab_force, of) in &hands {
            if let Ok(user) = users.get(of.0) {
                written = written.and(trace.put(tick.0, user.id, Some(grab_force.force), q));
            }
        }
        if let Err(error) = written {
            warn_once!("the trace is not whole: {error}");
        }
    }
}

/// Writes each tick that a guest shows, when it is first shown.
///
/// The streamed body is always written. While the guest's hand holds the body, the predicted body
/// is written too, with the reaction.
pub fn write_shown(
    trace: Option<ResMut<Trace>>,
    guest: Option<Res<NetGuest>>,
    bodies: Query<&RemoteBody>,
    forces: Query<&GrabForce, With<Grab>>,
) {
    let (Some(mut trace), Some(guest)) = (trace, guest) else { return };
    let user = guest.session().and_then(|session| session.user()).unwrap_or(UserId::HOST);
    for body in &bodies {
        let mut written = Ok(());
        if let Some(view) = guest.body(*body)
            && let Some(streamed) = view.visual()
            && view.tick() > trace.last
        {
            trace.last = view.tick();
            written = trace.put(view.tick(), UserId::HOST, None, &streamed.q);
        }
        if let (Some((tick, state)), Some(grab_force)) = (guest.visual_state(*body), forces.iter().next())
            && tick > trace.last_held
        {
            trace.last_held = tick;
            written = written.and(trace.put(tick, user, Some(grab_force.force), &state.q));
        }
        if let Err(error) = written {
            warn_once!("the trace is not whole: {error}");
        }
    }
}

struct Line {
    reaction: Vec3,
    q: Vec<f32>,
}

fn read(path: &Path) -> Result<BTreeMap<(u64, u16), Line>, Box<dyn Error>> {
    let mut file = BufReader::new(File::open(path).map_err(|error| format!("{}: {error}", path.display()))?);
    let mut lines = BTreeMap::new();
    loop {
        let mut head = [0; 24];
        if file.read_exact(&mut head).is_err() {
            return Ok(lines);
        }
        let number = |at: usize| u16::from_le_bytes([head[at], head[at + 1]]);
        let single = |at: usize| f32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        let tick = u64::from_le_bytes(head[..8].try_into()?);
        let mut bytes = vec![0; 4 * usize::from(number(22))];
        if file.read_exact(&mut bytes).is_err() {
            return Ok(lines);
        }
        let q = bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        let reaction = Vec3::new(single(10), single(14), single(18));
        lines.insert((tick, number(8)), Line { reaction, q });
    }
}

/// Returns the true modal coordinates by tick, from a host's file that may still grow.
pub fn truth(path: &Path) -> Result<BTreeMap<u64, Vec<f32>>, Box<dyn Error>> {
    let host = UserId::HOST.0;
    let lines = read(path)?.into_iter().filter(|((_, user), _)| *user == host);
    Ok(lines.map(|((tick, _), line)| (tick, line.q)).collect())
}

/// Errors of shown shapes, and the largest true displacement.
#[derive(Default)]
struct Off {
    ticks: u64,
    sum: f64,
    worst: f64,
    largest: f64,
    /// The ticks, and their errors over the surface (rms).
    each: Vec<(u64, f64)>,
}

impl Off {
    fn add(&mut self, model: &ModalModel, tick: u64, shown: &[f32], truth: &[f32]) {
        let rest = model.surface().positions();
        let shape = |q: &[f32]| {
            let mut q = q.to_vec();
            q.resize(model.mode_count(), 0.0);
            let mut out = vec![[0.0f32; 3]; rest.len()];
            model.basis().reconstruct(&q, true, &mut out);
            out
        };
        let (a, b) = (shape(shown), shape(truth));
        let places = rest.len().max(1) as f64;
        let far = |a: &[f32; 3], b: &[f32; 3]| f64::from(Vec3::from(*a).distance_squared(Vec3::from(*b)));
        let (mut mean, mut most, mut moved) = (0.0, 0.0f64, 0.0f64);
        for ((a, b), rest) in a.iter().zip(&b).zip(rest) {
            let error = far(a, b);
            mean += error / places;
            most = most.max(error);
            moved = moved.max(far(b, rest));
        }
        self.ticks += 1;
        self.sum += mean;
        self.each.push((tick, mean.sqrt()));
        self.worst = self.worst.max(most.sqrt());
        self.largest = self.largest.max(moved.sqrt());
    }

    fn rms(&self) -> f64 {
        percent((self.sum / self.ticks.max(1) as f64).sqrt(), self.largest)
    }

    /// Longest time in which the shape was off by more than a hundredth of the largest
    /// displacement, in ticks. It is back when it has been right for [`RIGHT_FOR`] shown ticks.
    fn longest(&self) -> u64 {
        let (mut longest, mut since, mut right) = (0, None, 0);
        for &(tick, error) in &self.each {
            if error > 0.01 * self.largest {
                let began = *since.get_or_insert(tick);
                longest = longest.max(tick + 1 - began);
                right = 0;
            } else {
                right += 1;
                since = since.filter(|_| right < RIGHT_FOR);
            }
        }
        longest
    }
}

/// A tenth of a second at forty ticks a second.
const RIGHT_FOR: u32 = 4;

fn percent(x: f64, of: f64) -> f64 {
    if of > 0.0 { 100.0 * x / of } else { 0.0 }
}

/// Prints how far the shapes and the reactions of a guest are from the truth of the same ticks.
///
/// The errors of the shapes are relative to the largest true displacement, separately for the
/// streamed body and for the body with the predicted hand. The errors of the reactions are relative
/// to the largest true reaction. The longest time in which the streamed body was off by more than 1
/// % (rms over its surface) is printed in ticks. The first `skip` ticks of the guest are left out.
pub fn compare(model: &ModalModel, truth: &Path, shown: &Path, skip: usize) -> Result<(), Box<dyn Error>> {
    let (truth, shown) = (read(truth)?, read(shown)?);
    let (mut streamed, mut own) = (Off::default(), Off::default());
    let (mut compared, mut force_sum, mut force_worst, mut force_most) = (0u64, 0.0f64, 0.0f64, 0.0f64);
    let host = UserId::HOST.0;
    // The largest reaction displayed to the user, and the largest true one at any tick.
    let (mut displayed, mut owner) = (0.0f64, host);
    let first = shown.keys().filter(|key| key.1 == host).nth(skip).map_or(u64::MAX, |key| key.0);
    for (&(tick, user), line) in shown.range((first, 0)..) {
        if user != host && line.reaction.is_finite() {
            displayed = displayed.max(f64::from(line.reaction.length()));
            owner = user;
        }
        let Some(real) = truth.get(&(tick, host)) else { continue };
        let off = if user == host { &mut streamed } else { &mut own };
        off.add(model, tick, &line.q, &real.q);
        if let Some(real) =
            truth.get(&(tick, user)).filter(|real| real.reaction.is_finite() && line.reaction.is_finite())
        {
            let error = f64::from(real.reaction.distance(line.reaction));
            compared += 1;
            force_sum += error * error;
            force_worst = force_worst.max(error);
            force_most = force_most.max(f64::from(real.reaction.length()));
        }
    }
    // Ticks between the first compared and the last shown tick that are missing were never shown.
    let last = shown.keys().rfind(|key| key.1 == host).map_or(first, |key| key.0);
    let span = last.saturating_sub(first) + 1;
    if streamed.ticks == 0 {
        return Err("no tick is in both files".into());
    }
    let given =
        truth.range((first, 0)..).filter(|((_, user), line)| *user == owner && line.reaction.is_finite());
    let given = given.map(|(_, line)| f64::from(line.reaction.length())).fold(0.0, f64::max);
    println!(
        "{} of {span} ticks: shown error {:.3} % rms, {:.1} % at most, of {:.1} mm; reaction {:.2} % rms, {:.1} % at most, of {force_most:.2} N ({compared} ticks); \
         predicted hand against the later state of the host, {:.2} % rms; \
         largest reaction {displayed:.2} N shown, {given:.2} N true; \
         shape off by more than 1 % for {} ticks at most",
        streamed.ticks,
        streamed.rms(),
        percent(streamed.worst, streamed.largest),
        streamed.largest * 1e3,
        percent((force_sum / compared.max(1) as f64).sqrt(), force_most),
        percent(force_worst, force_most),
        own.rms(),
        streamed.longest(),
    );
    Ok(())
}
