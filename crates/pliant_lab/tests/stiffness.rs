//! A body whose stiffness changes while it is streamed: guests are notified and keep their grabs.

use crate::support;

use pliant_modal::{BodyConfig, StepSettings};
use pliant_stream::{GuestEvent, GuestSessionConfig, HostSessionConfig};
use support::bar;
use support::scene::{BODY, S, Scene, cached, circling, paper1};

/// The largest visual error from a second after the change on, as a share of the largest shape.
fn after_a_change(announced: bool, scale: f64) -> f64 {
    let model = bar(24, 0.05);
    let mut pair = pliant_lab::pair::Pair::new(HostSessionConfig::default()).unwrap();
    let settings = StepSettings::default();
    pair.host.add_body(BODY, "bar", model.clone(), settings).unwrap();
    let mut scene = Scene::with(&model, &settings);
    scene.hand = circling();
    pair.join_with(GuestSessionConfig::default(), paper1(), 1, cached(&model)).unwrap();
    pair.run_until(5 * S, &mut scene);
    let stiff = StepSettings { stiffness_scale: scale, ..settings };
    let config = BodyConfig {
        settings: StepSettings { stiffness_scale: scale, ..scene.body.config().settings },
        ..scene.body.config().clone()
    };
    scene.body.reconfigure(config).unwrap();
    if announced {
        pair.host.set_settings(BODY, stiff).unwrap();
        // Setting the same settings again has no effect.
        pair.host.set_settings(BODY, stiff).unwrap();
    }
    scene.settled = 6 * S;
    pair.run_until(12 * S, &mut scene);
    let changes = scene.guest_events.iter().filter(|e| matches!(e.1, GuestEvent::BodyChanged { body: BODY }));
    assert_eq!(changes.count(), usize::from(announced), "announced once");
    let view = pair.guests[0].session.body(BODY).unwrap();
    assert_eq!(view.info().settings.stiffness_scale, if announced { scale } else { 1.0 });
    assert!(view.predicted_hand().is_some(), "the guest's hand is still on it");
    assert_eq!(scene.grabs.len(), 1, "at the host too");
    assert!(!scene.saw(0, |e| matches!(e, GuestEvent::BodyGone { .. })));
    assert!(pair.guests[0].session.user().is_some(), "and the guest in the session");
    scene.worst / scene.size()
}

#[test]
fn guests_follow_a_body_that_becomes_stiffer_or_softer_with_their_hands_on_it() {
    for scale in [4.0, 0.3] {
        let (announced, silent) = (after_a_change(true, scale), after_a_change(false, scale));
        println!("{scale} times as stiff: {:.3} % announced, {:.3} % not", 100.0 * announced, 100.0 * silent);
        assert!(announced < 0.05, "{scale}: {announced}");
        assert!(announced < 0.7 * silent, "{scale}: {announced} announced, {silent} not");
    }
}

#[test]
fn settings_of_another_body_under_a_known_number_ends_the_session() {
    let model = bar(12, 0.05);
    let mut pair = pliant_lab::pair::Pair::new(HostSessionConfig::default()).unwrap();
    pair.host.add_body(BODY, "bar", model.clone(), StepSettings::default()).unwrap();
    let mut scene = Scene::new(&model);
    pair.join_with(GuestSessionConfig::default(), paper1(), 1, cached(&model)).unwrap();
    pair.run_until(2 * S, &mut scene);
    let guest = &mut pair.guests[0].session;
    let mut info = guest.body(BODY).unwrap().info().clone();
    info.hash[0] ^= 1;
    let message = pliant_stream::wire::HostMessage::BodyAdded(info).encode();
    guest.on_message(2 * S, &message);
    assert!(guest.user().is_none(), "a broken promise ends it");
}
