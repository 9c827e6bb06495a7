//! Models sent to many guests at once: one rate for all, in fair turns, within each connection's
//! capacity.

use crate::support;

use std::collections::BTreeMap;
use std::time::Duration;

use pliant_modal::ModalModel;
use pliant_stream::{
    BodyId, Channel, GuestEvent, GuestSession, GuestSessionConfig, HostSession, HostSessionConfig, PeerId,
    StepSettings, StreamError, TickState,
};
use support::bar;

const BODY: BodyId = BodyId(9);
const GUESTS: u64 = 256;
const FRAME: Duration = Duration::from_micros(16_667);

/// The first messages of a guest that has no model.
fn hello() -> Vec<Vec<u8>> {
    let mut guest = GuestSession::new(GuestSessionConfig::default(), 1200).unwrap();
    guest.connect(Duration::ZERO).unwrap();
    std::iter::from_fn(|| guest.poll_output())
        .filter(|output| output.channel == Channel::Message)
        .map(|output| output.bytes.to_vec())
        .collect()
}

fn host(config: HostSessionConfig, guests: u64) -> (HostSession, u64) {
    let model = bar(40, 0.05);
    let bytes = model.to_bytes().len() as u64;
    // The guests send nothing while they wait, and the host must not disconnect them for it.
    let idle_timeout = Duration::from_secs(1000);
    let mut host = HostSession::new(HostSessionConfig { idle_timeout, ..config }).unwrap();
    host.add_body(BodyId(1), "bar", model, StepSettings::default()).unwrap();
    let words = hello();
    for peer in 1..=guests {
        host.connect(Duration::ZERO, PeerId(peer), 1200).unwrap();
        words.iter().for_each(|word| host.on_message(Duration::ZERO, PeerId(peer), word));
    }
    (host, bytes)
}

#[test]
fn two_hundred_and_fifty_six_fetch_at_once_at_one_rate_and_in_turns() {
    let config = HostSessionConfig { models_rate: 2e6, ..Default::default() };
    let (mut host, bytes) = host(config, GUESTS);
    assert_eq!(host.fetching().count() as u64, GUESTS);
    let mut got: BTreeMap<PeerId, u64> = BTreeMap::new();
    let (mut now, mut widest) = (Duration::ZERO, 0);
    while host.fetching().next().is_some() {
        assert!(now < Duration::from_secs(120), "{} still wait", host.fetching().count());
        host.update(now);
        while let Some(output) = host.poll_output() {
            if output.channel == Channel::Message {
                *got.entry(output.peer).or_default() += output.bytes.len() as u64;
            }
        }
        // At most the rate plus one burst of a tenth of a second. A guest's other messages take 20
        // kB, including the notices about all guests that joined.
        let sent: u64 = got.values().sum();
        let most = 2e6 * (now.as_secs_f64() + 0.1) + GUESTS as f64 * 20e3;
        assert!((sent as f64) < most, "{sent} bytes after {now:?}");
        let (least, most) = (got.values().min().unwrap(), got.values().max().unwrap());
        if got.len() as u64 == GUESTS && host.fetching().count() as u64 == GUESTS {
            widest = widest.max(most - least);
        }
        now += FRAME;
    }
    // The first guest is ahead by at most one piece of 16 KiB and its other messages.
    assert!(widest < 16 * 1024 + 25_000, "one is {widest} bytes ahead of another");
    let ideal = (GUESTS * bytes) as f64 / 2e6;
    let took = now.as_secs_f64();
    assert!((ideal - 0.2..1.05 * ideal + 0.2).contains(&took), "{took} s for {ideal} s of the rate");
    assert_eq!(host.users().count() as u64, GUESTS, "nobody was let go");
}

#[test]
fn one_alone_has_its_own_rate_and_not_that_of_all() {
    let (mut host, bytes) = host(HostSessionConfig { model_rate: 100e3, ..Default::default() }, 1);
    let mut now = Duration::ZERO;
    while host.fetching().next().is_some() {
        let wakes = host.next_wakeup().unwrap().max(now + Duration::from_micros(1));
        assert!(wakes < now + Duration::from_secs(1), "asleep with a model on its way");
        host.update(wakes);
        while host.poll_output().is_some() {}
        now = wakes;
    }
    // The host sends 64 KiB at once.
    let ideal = (bytes as f64 - 65_536.0) / 100e3;
    assert!((now.as_secs_f64() - ideal).abs() < 0.02 * ideal + 0.02, "{now:?} for {ideal} s");
}

#[test]
fn what_a_line_does_not_take_is_not_handed_over_and_holds_up_nobody_else() {
    let (mut host, bytes) = host(HostSessionConfig::default(), 2);
    let (slow, fast) = (PeerId(1), PeerId(2));
    let mut got = BTreeMap::from([(slow, 0_u64), (fast, 0)]);
    let mut unsent = 0.0_f64;
    let mut now = Duration::ZERO;
    let mut held = 0.0_f64;
    let mut until_fast = None;
    while host.fetching().next().is_some() {
        assert!(now < Duration::from_secs(300));
        host.set_unsent(slow, unsent as usize);
        host.update(now);
        while let Some(output) = host.poll_output() {
            *got.get_mut(&output.peer).unwrap() += output.bytes.len() as u64;
            if output.peer == slow {
                unsent += output.bytes.len() as f64;
            }
        }
        held = held.max(unsent);
        if !host.fetching().any(|peer| peer == fast) {
            until_fast.get_or_insert(now);
        }
        // The connection takes 50 kB/s where the host would send 1 MB/s.
        unsent = (unsent - 50e3 * FRAME.as_secs_f64()).max(0.0);
        now += FRAME;
    }
    assert!(held < (128.0 + 64.0 + 16.0) * 1024.0 + 5e3, "{held} bytes wait for a slow line");
    assert!(got[&slow] >= bytes && got[&fast] >= bytes);
    let (fast, ideal) = (until_fast.unwrap().as_secs_f64(), (bytes as f64 - 65_536.0) / 1e6);
    assert!(fast < 1.1 * ideal + 0.1, "the other had to wait: {fast} s for {ideal}");
}

#[test]
fn rates_that_are_none_are_refused() {
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        for config in [
            HostSessionConfig { model_rate: bad, ..Default::default() },
            HostSessionConfig { models_rate: bad, ..Default::default() },
        ] {
            assert!(matches!(HostSession::new(config), Err(StreamError::Config { .. })), "{bad}");
        }
    }
}

#[test]
fn a_model_may_be_read_by_the_caller_and_another_one_ends_the_session() {
    for right in [true, false] {
        let model = bar(8, 0.05);
        let mut host = HostSession::new(HostSessionConfig::default()).unwrap();
        let file = model.to_bytes().into();
        host.add_body_as(BODY, "bar", model.clone(), file, StepSettings::default()).unwrap();
        host.connect(Duration::ZERO, PeerId(1), 1200).unwrap();
        let mut guest =
            GuestSession::new(GuestSessionConfig { models_apart: true, ..Default::default() }, 1200).unwrap();
        guest.connect(Duration::ZERO).unwrap();
        let (mut came, mut ready, mut closed) = (None, false, false);
        for k in 1..200_u32 {
            let now = k * Duration::from_millis(25);
            while let Some(out) = guest.poll_output() {
                match out.channel {
                    Channel::Datagram => host.on_datagram(now, PeerId(1), &out.bytes),
                    Channel::Message => host.on_message(now, PeerId(1), &out.bytes),
                }
            }
            let q = vec![0.01; model.mode_count()];
            let state = TickState {
                tick: u64::from(k),
                q: &q,
                v: &q,
                a: &q,
                z: &[],
                pose: None,
                grabs: &[],
                resting: false,
            };
            host.publish(now, BODY, &state).unwrap();
            host.update(now);
            while let Some(out) = host.poll_output() {
                match out.channel {
                    Channel::Datagram => guest.on_datagram(now, &out.bytes),
                    Channel::Message => guest.on_message(now, &out.bytes),
                }
            }
            guest.update(now);
            while let Some(event) = guest.poll_event() {
                match event {
                    GuestEvent::ModelCame { hash, bytes } => came = Some((k, hash, bytes)),
                    GuestEvent::BodyReady { .. } => ready = true,
                    GuestEvent::Closed { .. } => closed = true,
                    _ => {}
                }
            }
            // The caller reads the model 20 ticks later, while frames arrive.
            if let Some((_, hash, bytes)) = came.take_if(|(at, ..)| *at + 20 < k) {
                assert!(!ready, "without its model");
                let read = ModalModel::from_bytes(&bytes).unwrap();
                assert_eq!(read.hash(), model.hash());
                // A model that the guest did not request changes nothing.
                guest.give_model([7; 32], Some(bar(4, 0.05)));
                guest.give_model(hash, Some(if right { read.into() } else { bar(4, 0.05) }));
            }
        }
        assert_eq!((ready, closed), (right, !right));
        assert_eq!(guest.body(BODY).is_some_and(|view| view.is_ready()), right);
    }
}
