//! The answers of the Inverse's service, from anybody.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#![cfg(feature = "inverse")]

#[path = "../../pliant_lab/tests/support/fuzzing.rs"]
mod fuzzing;
#[path = "rig/machine.rs"]
mod machine;
#[path = "inverse/service.rs"]
#[expect(dead_code, reason = "each test uses its part")]
mod service;

use pliant_haptics::{Fault, HapticDevice, Inverse, InverseConfig, LoopClock, RealScheduler, Wrench};
use service::{Service, state};

#[test]
fn no_text_of_the_service_panics_the_driver() {
    let service = Service::start(true);
    let mut device =
        Inverse::open(InverseConfig { device: Some("049D".into()), ..service.config() }).unwrap();
    let mut scheduler = RealScheduler::new(LoopClock::start(), 1000.0);
    let grip = r#"{"inverse3": [{"device_id": "049D", "state": {"cursor_position": {"x": 1e300, "y": -0.0,
        "z": 5e-324}, "cursor_velocity": {"x": 1, "y": 2}}}], "verse_grip": [{"state": {"orientation": {"w": 1,
        "x": 0, "y": 0, "z": 0}, "buttons": {"button_0": true, "button_1": false}}}]}"#;
    let corpus = vec![state(&service.desk(), true).to_string().into_bytes(), grip.as_bytes().to_vec()];
    // The target has no state of its own that an error could leave in two minds.
    let device = std::cell::RefCell::new((&mut device, &mut scheduler));
    fuzzing::run("inverse", corpus, |bytes| {
        service.desk().say = Some(String::from_utf8_lossy(bytes).into_owned());
        let (device, scheduler) = &mut *device.borrow_mut();
        match device.exchange(&Wrench::ZERO, *scheduler) {
            Ok(sample) => {
                let numbers = sample.position.iter().chain(&sample.orientation);
                assert!(numbers.chain(sample.velocity.iter().flatten()).all(|x| x.is_finite()));
            }
            Err(fault) => assert!(matches!(fault, Fault::Malformed | Fault::Gone), "{fault:?}"),
        }
    });
    assert_eq!(service.desk().refused, [""; 0]);
}
