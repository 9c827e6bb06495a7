//! Two guests hold one body, each with its own predicted hand: the gain, and what cannot be
//! predicted.
//!
//! The test compares three states at one moment: the streamed state (late but correct), the newer
//! predicted copy with the local hand, and the streamed state taken for the newer tick, which is
//! what a game without prediction shows. The copy cannot know when the other hand releases the
//! body.

use crate::support;

use std::sync::Arc;
use std::time::Duration;

use pliant_lab::pair::PathConfig;
use pliant_modal::{GrabConfig, ModalModel};
use pliant_stream::emulator::{LinkConfig, Preset};
use pliant_stream::{GuestSession, GuestSessionConfig};
use support::bar;
use support::scene::{BODY, HandScript, Observed, S, cached, start};

/// A shape, and the tick that the shape stands for.
type Shown = (u64, Vec<f64>);

/// Error against the host's shapes of the same ticks over the surface, root mean square and
/// largest, as shares of the largest displacement.
fn off(model: &ModalModel, truth: &[Shown], seen: &[Shown]) -> (f64, f64) {
    let rest = model.surface().positions();
    let (mut a, mut b) = (vec![[0.0f32; 3]; rest.len()], vec![[0.0f32; 3]; rest.len()]);
    let shape = |q: &[f64], out: &mut [[f32; 3]]| {
        let q: Vec<f32> = q.iter().map(|x| *x as f32).collect();
        model.basis().reconstruct(&q, true, out);
    };
    let far2 = |a: &[f32; 3], b: &[f32; 3]| (0..3).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>();
    let (mut sum, mut worst, mut largest, mut count) = (0.0, 0.0f64, 0.0f64, 0.0);
    for (tick, q) in seen {
        let Ok(at) = truth.binary_search_by_key(tick, |t| t.0) else { continue };
        shape(q, &mut a);
        shape(&truth[at].1, &mut b);
        for i in 0..rest.len() {
            let error = far2(&a[i], &b[i]);
            sum += error;
            count += 1.0;
            worst = worst.max(error);
            largest = largest.max(far2(&b[i], &rest[i]));
        }
    }
    assert!(count > 1000.0 * rest.len() as f64, "{count} places compared");
    ((sum / count / largest).sqrt(), (worst / largest).sqrt())
}

fn smooth(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
}

/// Behavior of the second hand.
#[derive(Clone, Copy, PartialEq)]
enum Other {
    Nothing,
    /// Grabs once and keeps the grab.
    Holds,
    /// Releases every five and a half seconds, as the first hand does.
    LetsGo,
}

/// Both hands pull with a small tremor, and the first hand releases now and then. They hold
/// vertices 66 and 34 of the bar.
fn hands(other: Other) -> HandScript {
    let mut grabs: [Option<(u16, f64)>; 2] = [None; 2];
    Box::new(move |now, guest, session| {
        if guest > 1 || session.user().is_none() || (guest == 1 && other == Other::Nothing) {
            return;
        }
        let (vertex, rest, pull) =
            [(66, [1.0, 0.08, 0.08], [0.0, 0.2, 0.1]), (34, [0.5, 0.08, 0.08], [0.0, -0.1, 0.1])][guest];
        let t = now.as_secs_f64();
        let since = t - [2.7, 2.0][guest];
        let phase = since % 5.5;
        let lets_go = guest == 0 || other == Other::LetsGo;
        match grabs[guest] {
            _ if since < 0.0 => {}
            Some((grab, _)) if phase > 4.5 && lets_go => {
                session.end_grab(grab);
                grabs[guest] = None;
            }
            Some((grab, began)) => {
                let t = t - began;
                let wave = |rate: f64, shift: f64| 0.2 * ((rate * t + shift).sin() - shift.sin());
                let aside = [wave(2.1, 0.0), wave(2.9, 0.8), wave(1.7, 1.9)];
                let length = pull.iter().map(|x| x * x).sum::<f64>().sqrt();
                let target =
                    std::array::from_fn(|k| rest[k] + smooth(t / 0.8) * (pull[k] + aside[k] * length));
                session.set_target(grab, target).unwrap();
            }
            None if phase < 2.2 => {
                let grab = session.begin_grab(now, BODY, vertex, 0.05, rest, GrabConfig::default()).ok();
                grabs[guest] = grab.map(|grab| (grab, t));
            }
            None => {}
        }
    })
}

/// Returns shares of the largest displacement: streamed (root mean square, largest), predicted hand
/// (root mean square), waiting (root mean square).
fn run(model: &Arc<ModalModel>, preset: Preset, other: Other) -> [f64; 4] {
    let (mut pair, scene) = start(model);
    let (mut streamed, mut own, mut waiting) =
        (Vec::<Shown>::new(), Vec::<Shown>::new(), Vec::<Shown>::new());
    let look = |now: Duration, guest: usize, stepped: u64, session: &mut GuestSession| {
        let Some(view) = session.body(BODY).filter(|_| guest == 0 && stepped > 0 && now > 4 * S) else {
            return;
        };
        let Some(seen) = view.visual() else { return };
        streamed.push((view.tick(), seen.q.clone()));
        let Some(predicted) = view.predicted_hand() else { return };
        if own.last().is_none_or(|last| last.0 < predicted.tick()) {
            own.push((predicted.tick(), predicted.visual().q.clone()));
            waiting.push((predicted.tick(), seen.q.clone()));
        }
    };
    let mut world = Observed { scene, look };
    world.scene.hand = hands(other);
    let path = PathConfig::symmetric(LinkConfig::preset(preset));
    for seed in [3, 4] {
        pair.join_with(GuestSessionConfig::default(), path.clone(), seed, cached(model)).unwrap();
    }
    pair.run_until(40 * S, &mut world);
    let truth = &world.scene.truth;
    let (streamed, most) = off(model, truth, &streamed);
    let [own, waiting] = [&own, &waiting].map(|seen| off(model, truth, seen).0);
    println!(
        "{}: streamed {:.4} % rms, {:.2} % at most; predicted hand {:.3} %, waiting {:.2} %",
        preset.name(),
        100.0 * streamed,
        100.0 * most,
        100.0 * own,
        100.0 * waiting
    );
    [streamed, most, own, waiting]
}

#[test]
fn own_hand_first_is_nearer_to_the_host_than_waiting_for_it() {
    let model = bar(40, 0.05);
    // (network, the other hand, largest error of the predicted hand, least ratio of the waiting
    // error to it)
    for (preset, other, most, times) in [
        (Preset::Paper1, Other::Nothing, 0.03, 8.0),
        (Preset::Paper1, Other::Holds, 0.03, 8.0),
        (Preset::Paper1, Other::LetsGo, 0.15, 2.0),
        (Preset::Paper4, Other::Nothing, 2e-4, 1000.0),
        (Preset::Paper4, Other::LetsGo, 0.025, 4.0),
    ] {
        let [streamed, worst, own, waiting] = run(&model, preset, other);
        // The streamed state must stay within the bounds of streaming in every case.
        assert!(streamed < 1.5e-3 && worst < 0.05, "{}: {streamed}, {worst}", preset.name());
        assert!(own < most, "{}: {own}", preset.name());
        assert!(waiting > times * own, "{}: waiting {waiting}, predicted hand {own}", preset.name());
    }
}
