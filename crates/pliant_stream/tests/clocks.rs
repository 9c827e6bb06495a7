//! Clocks that differ by years. Sessions use only elapsed time, never absolute time.

use crate::support;

use std::collections::BTreeMap;
use std::time::Duration;

use pliant_modal::{Body, BodyConfig, GrabConfig, Patch};
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss, Preset};
use pliant_stream::{
    BodyId, Channel, GrabKey, GrabState, GuestSession, GuestSessionConfig, HostSession, HostSessionConfig,
    PeerId, StepSettings, TickState, UserId,
};
use support::bar;

const BODY: BodyId = BodyId(1);
const GUEST: PeerId = PeerId(1);
const YEAR: Duration = Duration::from_secs(365 * 86_400);
const MS: Duration = Duration::from_millis(1);

/// Runs a session over the paper's first network with two clocks that begin at the given times.
/// Returns the guest's visual coordinates per tick, the true coordinates per tick and the clock
/// offset, s.
fn visual(
    host_clock: Duration,
    guest_clock: Duration,
) -> (BTreeMap<u64, Vec<f64>>, BTreeMap<u64, Vec<f64>>, f64) {
    let model = bar(12, 0.05);
    let mut host = HostSession::new(HostSessionConfig::default()).unwrap();
    host.add_body(BODY, "bar", model.clone(), StepSettings::default()).unwrap();
    let mut guest = GuestSession::new(GuestSessionConfig::default(), 1200).unwrap();
    guest.add_cached_model(model.clone());
    host.connect(host_clock, GUEST, 1200).unwrap();
    guest.connect(guest_clock).unwrap();
    let mut body = Body::new(model.clone(), BodyConfig { step: 0.025, ..Default::default() }).unwrap();
    let patch = Patch::around(model.surface(), 66, 0.05).unwrap();
    let grab = body.grab(&patch, GrabConfig::default()).unwrap();
    let lossy = LinkConfig::preset(Preset::Paper1);
    let whole = LinkConfig { loss: Loss::None, keep_order: true, ..lossy.clone() };
    let [mut down, mut up] = [1, 2].map(|seed| EmulatedLink::<Vec<u8>>::new(lossy.clone(), seed));
    let [mut said_down, mut said_up] = [3, 4].map(|seed| EmulatedLink::<Vec<u8>>::new(whole.clone(), seed));
    let (mut truth, mut seen) = (BTreeMap::new(), BTreeMap::new());
    let mut passed = Duration::ZERO;
    while passed < Duration::from_secs(8) {
        let (at_host, at_guest) = (host_clock + passed, guest_clock + passed);
        if passed.as_micros().is_multiple_of(25_000) {
            let tick = passed.as_micros() as u64 / 25_000 + 1;
            let t = passed.as_secs_f64();
            body.set_target(grab, [1.0, 0.08 + 0.1 * (1.3 * t).sin(), 0.08 + 0.1 * (1.7 * t).sin()]).unwrap();
            body.step().unwrap();
            let grabs = [GrabState {
                key: GrabKey { user: UserId::HOST, grab: 1 },
                vertex: 66,
                radius: 0.05,
                target: body.target(grab).unwrap(),
                reaction: body.reaction(grab).unwrap(),
                hold: GrabConfig::default(),
            }];
            truth.insert(tick, body.q().to_vec());
            let (q, v, a) = (body.q(), body.v(), body.a());
            let state = TickState { tick, q, v, a, z: &[], pose: None, grabs: &grabs, resting: false };
            host.publish(at_host, BODY, &state).unwrap();
        }
        while let Some(bytes) = said_up.poll(passed) {
            host.on_message(at_host, GUEST, &bytes);
        }
        while let Some(bytes) = up.poll(passed) {
            host.on_datagram(at_host, GUEST, &bytes);
        }
        while let Some(bytes) = said_down.poll(passed) {
            guest.on_message(at_guest, &bytes);
        }
        while let Some(bytes) = down.poll(passed) {
            guest.on_datagram(at_guest, &bytes);
        }
        host.update(at_host);
        guest.update(at_guest);
        while let Some(o) = host.poll_output() {
            let link = if o.channel == Channel::Datagram { &mut down } else { &mut said_down };
            link.send(passed, o.bytes.to_vec(), o.bytes.len());
        }
        while let Some(o) = guest.poll_output() {
            let link = if o.channel == Channel::Datagram { &mut up } else { &mut said_up };
            link.send(passed, o.bytes.to_vec(), o.bytes.len());
        }
        if let Some(view) = guest.body(BODY).filter(|view| view.is_ready()) {
            let q = view.visual().unwrap().q.clone();
            seen.insert(view.tick(), q);
        }
        passed += 5 * MS;
    }
    assert!(!guest.is_closed());
    assert_eq!((guest.stats().rejected, host.users().count()), (0, 1));
    let round_trip = guest.stats().round_trip.as_secs_f64();
    assert!((0.19..0.25).contains(&round_trip), "196 ms, whatever the clocks say: {round_trip}");
    (seen, truth, guest.clock_offset().unwrap())
}

#[test]
fn a_guest_and_a_host_whose_clocks_differ_by_years_see_the_same() {
    let (same, truth, _) = visual(Duration::ZERO, Duration::ZERO);
    let size = truth.values().flatten().fold(0.0_f64, |size, q| size.max(q.abs()));
    for (host, guest) in [(40 * YEAR, Duration::ZERO), (Duration::ZERO, 40 * YEAR), (70 * YEAR, 30 * YEAR)] {
        let (seen, _, offset) = visual(host, guest);
        let expected = host.as_secs_f64() - guest.as_secs_f64();
        assert!((offset - expected).abs() < 0.02, "{offset} s between the clocks, truly {expected}");
        // The guest needs two seconds to find the clock offset and the hand. After that every
        // visual tick matches, as it does with equal clocks.
        let worst = |seen: &BTreeMap<u64, Vec<f64>>| {
            let late = seen.range(80..);
            late.map(|(tick, q)| q.iter().zip(&truth[tick]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max))
                .fold(0.0, f64::max)
                / size
        };
        let (bare, years) = (worst(&same), worst(&seen));
        assert!(seen.len() + 3 > same.len(), "{} ticks of {}", seen.len(), same.len());
        assert!(years < bare + 1e-3 && years < 0.03, "off by {years}, by {bare} with one clock");
    }
}
