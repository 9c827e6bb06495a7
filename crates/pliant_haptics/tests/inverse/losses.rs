//! An Inverse that is not ready, is not calibrated, or whose answers come late.

use std::time::Duration;

use pliant_haptics::{
    Calibration, Cycle, Fault, HapticDevice, Inverse, LocalModel, LoopConfig, LoopEvent, LoopState,
    VirtualScheduler, Wrench,
};
use serde_json::{Value, json};

use super::{HASTE, answer, hasty, machine, pacing, second, service::Service};

/// The `status` of a device that is ready, as the service's documentation shows it.
fn ready() -> Value {
    json!({ "calibrated": true, "in_use": true, "power_supply": true, "ready": true, "started": true })
}

/// A loop in virtual time whose hand stretches a spring of 100 N/m by 4 mm.
struct Pulled {
    cycle: Cycle<Inverse>,
    scheduler: VirtualScheduler,
    model: LocalModel,
    events: Vec<LoopEvent>,
}

impl Pulled {
    pub(super) fn new(service: &Service) -> Self {
        service.desk().position = [0.004, 0.0, 0.0];
        let device = Inverse::open(second(service.config())).unwrap();
        let mut model = LocalModel { count: 1, period: 0.01, ..LocalModel::default() };
        model.contacts[0].stiffness = [[100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]];
        Self {
            cycle: Cycle::new(device, LoopConfig::default()).unwrap(),
            scheduler: VirtualScheduler::new(1000.0),
            model,
            events: Vec::new(),
        }
    }

    pub(super) fn run(&mut self, periods: usize) {
        for _ in 0..periods {
            self.model.tick += 1;
            self.cycle.step(&mut self.scheduler, &self.model, &mut self.events);
        }
    }

    /// Runs until the motors have 0.4 N. On a busy machine a force is renewed late in real time, so
    /// that it begins anew at zero.
    #[track_caller]
    fn run_to_the_force(&mut self, service: &Service, when: &str) {
        machine::until(when, || {
            self.run(50);
            let motor = service.desk().motor;
            if (motor - 0.4).abs() < 1e-3 { Ok(()) } else { Err(motor) }
        });
    }
}

/// Says by `field` of the status that something is missing, for a while in the middle of a grab.
/// Returns the events of that while.
#[track_caller]
fn without(field: &str, want: LoopState) -> Vec<LoopEvent> {
    let service = Service::start(true);
    service.desk().status = ready();
    let mut pulled = Pulled::new(&service);
    pulled.run_to_the_force(&service, "the force before");
    pulled.events.clear();
    service.desk().status[field] = json!(false);
    // The answer to the first command says it, and the second command is without a force.
    pulled.run(2);
    let at_once = service.desk().motor;
    pulled.run(400);
    let meanwhile = service.desk().motor;
    println!("Inverse without `{field}`: 0.4 N, then {at_once:.3} N, {meanwhile:.3} N in the end");
    assert_eq!((at_once, meanwhile), (0.0, 0.0), "{field}: no force is sent");
    assert_eq!(pulled.cycle.report().state, want, "{field}");
    let events = std::mem::take(&mut pulled.events);
    service.desk().rise = 0.0;
    service.desk().status = ready();
    pulled.run_to_the_force(&service, "the force afterwards");
    let rise = service.desk().rise;
    println!("Inverse with `{field}` again: 0.4 N, rises by at most {rise:.4} N a period");
    // The ramp brings the peak force of 10 N in 0.3 s, and 0.4 N are 1.3 mN per period.
    assert!(rise < 0.002, "{field}: by the ramp, not by a kick of {rise} N");
    assert_eq!(pulled.cycle.report().state, LoopState::Running, "{field}");
    assert_eq!(service.desk().refused, [""; 0]);
    events
}

#[test]
fn an_inverse_that_loses_its_calibration_exerts_no_force() {
    let events = without("calibrated", LoopState::Calibrating);
    assert!(events.contains(&LoopEvent::Fault(Fault::NotCalibrated)), "{events:?}");
    assert!(events.iter().any(|e| matches!(e, LoopEvent::Calibrate(_))), "{events:?}");
}

#[test]
fn an_inverse_without_power_or_not_ready_is_switched_off() {
    for field in ["power_supply", "ready"] {
        let events = without(field, LoopState::ForceOff);
        assert!(events.contains(&LoopEvent::Fault(Fault::ForceOff)), "{field}: {events:?}");
    }
}

#[test]
fn an_inverse_is_not_calibrated_until_a_message_says_so() {
    for (once, says) in [(false, true), (true, false)] {
        let service = Service::start(true);
        let mut status = ready();
        status["calibrated"] = json!(false);
        service.desk().status = status;
        // A service that says it in its inventory only is believed until the next connection.
        service.desk().status_once = once;
        let mut pulled = Pulled::new(&service);
        assert!(matches!(pulled.cycle.device_mut().calibration(), Calibration::Needed(_)));
        pulled.run(400);
        assert!(service.desk().forces.iter().flatten().all(|x| *x == 0.0), "no force before");
        if says {
            service.desk().status = ready();
            pulled.run_to_the_force(&service, "a message says that it is calibrated");
        } else {
            pulled.run(1000);
            let motor = service.desk().motor;
            assert_eq!(motor, 0.0, "no message says it");
        }
        service.desk().status_once = false;
        service.desk().status = ready();
        pulled.cycle.device_mut().reopen().unwrap();
        pulled.run_to_the_force(&service, "after a new connection");
    }
}

#[test]
fn a_late_renewal_sends_zero_first() {
    let service = Service::start(true);
    let mut device = Inverse::open(second(service.config())).unwrap();
    let pull = Wrench { force: [1.0, 0.0, 0.0], ..Wrench::ZERO };
    let pulls = |device: &mut Inverse| {
        machine::until("1 N on the motors", || {
            let sample = device.exchange(&pull, &mut pacing());
            let motor = service.desk().motor;
            if sample.is_ok_and(|s| s.force_on) && motor == 1.0 { Ok(()) } else { Err(sample) }
        });
    };
    pulls(&mut device);
    std::thread::sleep(Duration::from_millis(40));
    let late = device.exchange(&pull, &mut pacing()).unwrap();
    let motor = service.desk().motor;
    println!("Inverse: {motor} N after a late renewal");
    assert_eq!((motor, late.force_on), (0.0, false), "a force that may be off comes back at zero");
    pulls(&mut device);
}

#[test]
fn a_late_answer_is_not_taken_for_the_next_one() {
    let service = Service::start(true);
    let mut device = hasty(&service);
    answer(&mut device);
    service.desk().late = true;
    assert_eq!(device.exchange(&Wrench::ZERO, &mut pacing()).unwrap_err(), Fault::Timeout(HASTE));
    service.send_late();
    for k in 1..=100 {
        let x = 1e-4 * f64::from(k);
        service.desk().position = [x, 0.0, 0.0];
        let off = (answer(&mut device).position[0] - x).abs();
        assert!(off < 1e-9, "where the hand is now, not an exchange ago: off by {off} m");
    }
    // A stop whose answer is late must not leave that answer behind either.
    service.desk().late = true;
    device.safe_stop();
    service.send_late();
    answer(&mut device);
    service.desk().position = [0.07, 0.0, 0.0];
    assert!((answer(&mut device).position[0] - 0.07).abs() < 1e-9);
}
