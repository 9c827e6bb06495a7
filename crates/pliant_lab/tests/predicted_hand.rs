//! Tests of the predicted hand: the guest's own copy of a body that answers the local hand at once.

use crate::support;

use std::time::Duration;

use pliant_lab::pair::{Pair, PathConfig, World};
use pliant_modal::GrabConfig;
use pliant_stream::emulator::{LinkConfig, Preset};
use pliant_stream::{
    GrabKey, GuestEvent, GuestSession, GuestSessionConfig, HostEvent, HostSession, HostSessionConfig,
    RigidState, StepSettings,
};
use support::scene::{BODY, Observed, S, Scene, cached, circling, circling_with, start};
use support::{bar, loose_bar};

#[test]
fn own_hand_does_not_wait_for_the_round_trip() {
    // Compare the guest's predicted copy with the host's later results for the same ticks.
    for (preset, bar_shape, bar_force) in
        [(Preset::Paper4, 0.002, 0.005), (Preset::Paper2, 0.02, 0.1), (Preset::Paper1, 0.02, 0.1)]
    {
        let model = bar(40, 0.05);
        let (mut pair, scene) = start(&model);
        struct Watch {
            scene: Scene,
            seen: Vec<(u64, Vec<f64>, [f64; 3])>,
            forces: Vec<(u64, [f64; 3])>,
            leads: Vec<usize>,
            other: bool,
        }
        impl World for Watch {
            fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession) {
                self.scene.step(now, tick, host);
                if let Some(g) = self.scene.grabs.first() {
                    self.forces.push((tick, self.scene.body.reaction(g.1).unwrap()));
                }
            }
            fn host_event(&mut self, now: Duration, event: HostEvent, host: &mut HostSession) {
                self.scene.host_event(now, event, host);
            }
            fn guest_event(&mut self, now: Duration, guest: usize, event: GuestEvent, s: &mut GuestSession) {
                self.scene.guest_event(now, guest, event, s);
            }
            fn guest_stepped(
                &mut self,
                now: Duration,
                guest: usize,
                stepped: u64,
                session: &mut GuestSession,
            ) {
                self.scene.guest_stepped(now, guest, stepped, session);
                let Some(own) = session.body(BODY).and_then(|b| b.predicted_hand()) else { return };
                if guest == 0 && stepped > 0 && now > 8 * S {
                    let reaction = own.reaction(0).expect("the grab is held");
                    self.seen.push((own.tick(), own.visual().q.clone(), reaction));
                    self.leads.push(own.lead());
                } else if guest == 1 {
                    self.other = true;
                }
            }
        }
        let mut watch =
            Watch { scene, seen: Vec::new(), forces: Vec::new(), leads: Vec::new(), other: false };
        watch.scene.hand = circling();
        let path = PathConfig::symmetric(LinkConfig::preset(preset));
        for seed in [3, 4] {
            pair.join_with(GuestSessionConfig::default(), path.clone(), seed, cached(&model)).unwrap();
        }
        pair.run_until(40 * S, &mut watch);
        assert!(!watch.other, "a guest that holds nothing has no newer copy");
        let size = watch.scene.size();
        let strongest =
            watch.forces.iter().map(|f| f.1.iter().map(|x| x * x).sum::<f64>().sqrt()).fold(0.0, f64::max);
        let (mut shape, mut force, mut count) = (0.0, 0.0, 0.0);
        for (tick, q, reaction) in &watch.seen {
            let Some((_, truth)) = watch.scene.truth.iter().find(|t| t.0 == *tick) else { continue };
            let Some((_, real)) = watch.forces.iter().find(|f| f.0 == *tick) else { continue };
            shape += q.iter().zip(truth).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
            force += (0..3).map(|k| (reaction[k] - real[k]).powi(2)).sum::<f64>();
            count += 1.0;
        }
        assert!(count > 1000.0, "{count} ticks compared");
        let (shape, force) = ((shape / count).sqrt() / size, (force / count).sqrt() / strongest);
        let lead = watch.leads[watch.leads.len() / 2];
        println!(
            "{}: ahead by {lead} ticks, shape off {:.3} %, reaction off {:.3} %",
            preset.name(),
            shape * 100.0,
            force * 100.0
        );
        // Round trip and playout delay in ticks, rounded up by the steps of the host and the guest.
        let whole = (preset.round_trip().as_secs_f64() / 0.025) as usize;
        assert!(
            (whole + 1..=whole + 4).contains(&lead),
            "{}: lead {lead} for {whole} ticks of round trip",
            preset.name()
        );
        assert!(shape < bar_shape, "{}: shape {shape}", preset.name());
        assert!(force < bar_force, "{}: reaction {force}", preset.name());
    }
}

#[test]
fn own_hand_on_a_free_body_takes_its_frame_along() {
    // A free body falls slowly and is dragged. Compare the pose of the copy with the host's later
    // pose of the same ticks.
    let model = loose_bar(24, 0.05);
    let settings = StepSettings { gravity: [0.0, 0.0, -0.3], ..Default::default() };
    let mut pair = Pair::new(HostSessionConfig::default()).unwrap();
    pair.host.add_body(BODY, "bar", model.clone(), settings).unwrap();
    let (mut own, mut shown) = (Vec::new(), Vec::new());
    let look = |now: Duration, _: usize, stepped: u64, session: &mut GuestSession| {
        let Some(view) = session.body(BODY).filter(|_| stepped > 0 && now > 6 * S) else { return };
        shown.extend(view.pose().map(|pose| (view.tick(), pose)));
        let Some(predicted) = view.predicted_hand() else { return };
        own.push((predicted.tick(), predicted.pose().expect("a free body has a frame")));
    };
    let mut world = Observed { scene: Scene::with(&model, &settings), look };
    world.scene.hand = circling();
    let path = PathConfig::symmetric(LinkConfig::preset(Preset::Paper2));
    pair.join_with(GuestSessionConfig::default(), path, 3, cached(&model)).unwrap();
    pair.run_until(25 * S, &mut world);
    let poses = &world.scene.poses;
    let off = |seen: &[(u64, RigidState)]| {
        let (mut sum, mut count) = (0.0, 0.0_f64);
        for (tick, pose) in seen {
            let Some((_, truth)) = poses.iter().find(|p| p.0 == *tick) else { continue };
            sum += (0..3).map(|k| (pose.position[k] - truth.position[k]).powi(2)).sum::<f64>();
            count += 1.0;
        }
        assert!(count > 500.0, "{count} ticks compared");
        (sum / count).sqrt()
    };
    let moved = poses.iter().map(|p| p.1.position.iter().map(|x| x * x).sum::<f64>().sqrt());
    let moved = moved.fold(0.0, f64::max);
    let (own, shown) = (off(&own), off(&shown));
    println!("moved by {moved:.3} m; own copy off by {own:.5} m, shown by {shown:.5} m");
    assert!(moved > 0.1);
    assert!(own < 0.02 * moved, "{own} m of {moved} m");
    assert!(shown < 0.01 * moved, "{shown} m of {moved} m");
}

#[test]
fn anothers_soft_hand_on_a_free_body_is_predicted_as_soft_as_it_is() {
    // One guest swings a free bar about on a soft, damped spring, and the other one holds it at the
    // other end. The copy of the second guest has to know the spring, because the bar lags far
    // behind the first hand. Compare it with the host's later state of the same ticks.
    let model = loose_bar(24, 0.05);
    let mut pair = Pair::new(HostSessionConfig::default()).unwrap();
    pair.host.add_body(BODY, "bar", model.clone(), StepSettings::default()).unwrap();
    let (mut seen, mut user) = (Vec::new(), None);
    let look = |now: Duration, guest: usize, stepped: u64, session: &mut GuestSession| {
        let Some(view) = session.body(BODY).filter(|_| guest == 1 && stepped > 0 && now > 6 * S) else {
            return;
        };
        let Some(own) = view.predicted_hand() else { return };
        user = session.user();
        seen.extend(own.pose().zip(own.reaction(0)).map(|(pose, f)| (own.tick(), pose, f)));
    };
    let mut world = Observed { scene: Scene::with(&model, &StepSettings::default()), look };
    let mut swing = circling_with(GrabConfig { stiffness: Some(20.0), relaxation: 0.1 });
    let mut grab = None;
    world.scene.hand = Box::new(move |now, guest, session| {
        swing(now, guest, session);
        if guest == 1 && session.user().is_some() && grab.is_none() {
            let own = GrabConfig { stiffness: Some(40.0), relaxation: 0.1 };
            grab = session.begin_grab(now, BODY, 2, 0.05, [0.0, 0.08, 0.08], own).ok();
        }
    });
    let path = PathConfig::symmetric(LinkConfig::preset(Preset::Paper2));
    for seed in [3, 4] {
        pair.join_with(GuestSessionConfig::default(), path.clone(), seed, cached(&model)).unwrap();
    }
    pair.run_until(25 * S, &mut world);
    let scene = &world.scene;
    let key = GrabKey { user: user.expect("the second guest has joined"), grab: 0 };
    let far2 = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>();
    let (mut place, mut force, mut strongest, mut count) = (0.0, 0.0, 0.0f64, 0.0);
    for (tick, pose, reaction) in &seen {
        let Some((_, truth)) = scene.poses.iter().find(|p| p.0 == *tick) else { continue };
        let Some((_, _, right)) = scene.reactions.iter().find(|r| r.0 == *tick && r.1 == key) else {
            continue;
        };
        place += far2(pose.position, truth.position);
        force += far2(*reaction, *right);
        strongest = strongest.max(far2(*right, [0.0; 3]));
        count += 1.0;
    }
    assert!(count > 500.0, "{count} ticks compared");
    let spread = |k: usize| {
        let all = scene.poses.iter().filter(|p| p.0 > 240).map(|p| p.1.position[k]);
        all.clone().fold(f64::MIN, f64::max) - all.fold(f64::MAX, f64::min)
    };
    let moved = (0..3).map(spread).fold(0.0, f64::max);
    let place = (place / count).sqrt() / moved;
    let force = (force / count / strongest).sqrt();
    println!(
        "the bar moves by {moved:.3} m; place off by {:.2} % of it, own force by {:.2} % of {:.3} N",
        100.0 * place,
        100.0 * force,
        strongest.sqrt()
    );
    assert!(place < 0.005, "{place}");
    assert!(force < 0.05, "{force}");
}

#[test]
fn anothers_soft_hand_on_an_anchored_body_is_predicted_as_soft_as_it_is() {
    // One guest swings the free end of a bar on a soft, damped spring, and the other one shakes it
    // close by. The patch of the first hand gives way to the second one, and the copy of the second
    // guest has to know that. Compare it with the host's later state of the same ticks.
    let model = bar(40, 0.05);
    let (mut pair, scene) = start(&model);
    let (mut seen, mut user) = (Vec::new(), None);
    let look = |now: Duration, guest: usize, stepped: u64, session: &mut GuestSession| {
        let Some(view) = session.body(BODY).filter(|_| guest == 1 && stepped > 0 && now > 6 * S) else {
            return;
        };
        let Some(own) = view.predicted_hand() else { return };
        user = session.user();
        seen.extend(own.reaction(0).map(|f| (own.tick(), own.visual().q.clone(), f)));
    };
    let mut world = Observed { scene, look };
    let soft = GrabConfig { stiffness: Some(50.0), relaxation: 0.02 };
    let mut swing = circling_with(soft);
    let mut grab = None;
    world.scene.hand = Box::new(move |now, guest, session| {
        swing(now, guest, session);
        if guest != 1 || session.user().is_none() {
            return;
        }
        let t = now.as_secs_f64();
        let target = [0.9, 0.08 + 0.1 * (3.1 * t).sin(), 0.08 + 0.1 * (2.3 * t).sin()];
        match grab {
            None => grab = session.begin_grab(now, BODY, 58, 0.05, target, soft).ok(),
            Some(grab) => session.set_target(grab, target).unwrap(),
        }
    });
    let path = PathConfig::symmetric(LinkConfig::preset(Preset::Paper2));
    for seed in [3, 4] {
        pair.join_with(GuestSessionConfig::default(), path.clone(), seed, cached(&model)).unwrap();
    }
    pair.run_until(25 * S, &mut world);
    let scene = &world.scene;
    let key = GrabKey { user: user.expect("the second guest has joined"), grab: 0 };
    let far2 = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
    let (mut shape, mut force, mut strongest, mut count) = (0.0, 0.0, 0.0f64, 0.0);
    for (tick, q, reaction) in &seen {
        let Some((_, truth)) = scene.truth.iter().find(|t| t.0 == *tick) else { continue };
        let Some((_, _, right)) = scene.reactions.iter().find(|r| r.0 == *tick && r.1 == key) else {
            continue;
        };
        shape += far2(q, truth);
        force += far2(reaction, right);
        strongest = strongest.max(far2(right, &[0.0; 3]));
        count += 1.0;
    }
    assert!(count > 500.0, "{count} ticks compared");
    let shape = (shape / count).sqrt() / scene.size();
    let force = (force / count / strongest).sqrt();
    println!(
        "shape off by {:.2} % of the largest, own force by {:.2} % of {:.3} N",
        100.0 * shape,
        100.0 * force,
        strongest.sqrt()
    );
    assert!(shape < 0.01, "{shape}");
    assert!(force < 0.03, "{force}");
}
