//! What the host computed and what a guest showed, tick by tick, in files: to be compared when both have ended, on whatever machines they ran.
//!
//! A record: `u64` tick, `u16` user, 3 x `f32` reaction on that user's hand (N; NaN where it has none), `u16` number of modes, so many `f32`.

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

/// The file that is written.
#[derive(Resource)]
pub struct Trace {
    file: BufWriter<File>,
    last: u64,
}

impl Trace {
    pub fn create(path: &Path) -> Result<Self, Box<dyn Error>> {
        let file = File::create(path).map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(Self { file: BufWriter::new(file), last: 0 })
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

/// After each step of the host: the truth, once for every user that holds the body, or once.
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
        for (felt, of) in &hands {
            if let Ok(user) = users.get(of.0) {
                written = written.and(trace.put(tick.0, user.id, Some(felt.force), q));
            }
        }
        if let Err(error) = written {
            warn_once!("the trace is not whole: {error}");
        }
    }
}

/// Each tick that a guest shows, as it was shown first: the newer copy's while its hand holds the body.
pub fn write_shown(
    trace: Option<ResMut<Trace>>,
    guest: Option<Res<NetGuest>>,
    bodies: Query<&RemoteBody>,
    forces: Query<&GrabForce, With<Grab>>,
) {
    let (Some(mut trace), Some(guest)) = (trace, guest) else { return };
    let user = guest.session().and_then(|session| session.user()).unwrap_or(UserId::HOST);
    for body in &bodies {
        let Some((tick, state)) = guest.shown(*body) else { continue };
        if tick <= trace.last {
            continue;
        }
        trace.last = tick;
        let felt = forces.iter().next().map(|felt| felt.force);
        if let Err(error) = trace.put(tick, user, felt, &state.q) {
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

/// Compares what a guest has shown with the truth of the same ticks: over the surface, as parts of the largest true displacement, and the reactions as
/// parts of the largest true one. The first `skip` ticks of the guest are left out.
pub fn compare(model: &ModalModel, truth: &Path, shown: &Path, skip: usize) -> Result<(), Box<dyn Error>> {
    let (truth, shown) = (read(truth)?, read(shown)?);
    let rest = model.surface().positions();
    let (mut a, mut b) = (vec![[0.0f32; 3]; rest.len()], vec![[0.0f32; 3]; rest.len()]);
    let whole = |q: &[f32]| {
        let mut q = q.to_vec();
        q.resize(model.mode_count(), 0.0);
        q
    };
    let (mut ticks, mut sum, mut worst, mut largest) = (0u64, 0.0f64, 0.0f64, 0.0f64);
    let (mut felt, mut force_sum, mut force_worst, mut force_most) = (0u64, 0.0f64, 0.0f64, 0.0f64);
    let rest_count = rest.len().max(1) as f64;
    let far = |a: &[f32; 3], b: &[f32; 3]| f64::from(Vec3::from(*a).distance_squared(Vec3::from(*b)));
    for (&(tick, user), line) in shown.iter().skip(skip) {
        let Some(host) = truth.get(&(tick, UserId::HOST.0)) else { continue };
        model.basis().reconstruct(&whole(&line.q), true, &mut a);
        model.basis().reconstruct(&whole(&host.q), true, &mut b);
        let (mut mean, mut most, mut moved) = (0.0, 0.0f64, 0.0f64);
        for ((a, b), rest) in a.iter().zip(&b).zip(rest) {
            let error = far(a, b);
            mean += error / rest_count;
            most = most.max(error);
            moved = moved.max(far(b, rest));
        }
        ticks += 1;
        sum += mean;
        worst = worst.max(most.sqrt());
        largest = largest.max(moved.sqrt());
        if let Some(own) =
            truth.get(&(tick, user)).filter(|own| own.reaction.is_finite() && line.reaction.is_finite())
        {
            let error = f64::from(own.reaction.distance(line.reaction));
            felt += 1;
            force_sum += error * error;
            force_worst = force_worst.max(error);
            force_most = force_most.max(f64::from(own.reaction.length()));
        }
    }
    if ticks == 0 {
        return Err("no tick is in both files".into());
    }
    let part = |x: f64, of: f64| if of > 0.0 { 100.0 * x / of } else { 0.0 };
    println!(
        "{ticks} ticks: shown error {:.2} % rms, {:.1} % at most, of {:.1} mm; reaction {:.2} % rms, {:.1} % at most, of {force_most:.2} N ({felt} ticks)",
        part((sum / ticks as f64).sqrt(), largest),
        part(worst, largest),
        largest * 1e3,
        part((force_sum / felt.max(1) as f64).sqrt(), force_most),
        part(force_worst, force_most),
    );
    Ok(())
}
