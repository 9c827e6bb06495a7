use nalgebra::Vector3;

use super::*;
use crate::VirtualConfig;

fn info() -> DeviceInfo {
    VirtualConfig::touch().info()
}

fn wanted(force: f64) -> Wanted {
    Wanted {
        dt: 1e-3,
        moved: Vector3::zeros(),
        velocity: Vector3::zeros(),
        elastic: Vector3::new(force, 0.0, 0.0),
        damping: Vector3::zeros(),
        weight: Vector3::zeros(),
        stored: 1.0,
        partial: false,
        supplied: 0.0,
        growing: false,
        one_sided: false,
        holding: true,
        silent: 0.0,
        interval: 0.0,
        fault: None,
        stop: false,
    }
}

/// Runs until the ramp is over.
fn engaged(force: f64) -> Safety {
    let mut safety = Safety::new(SafetyConfig::for_device(&info(), 1000.0), 0.045);
    for _ in 0..400 {
        safety.tick(&wanted(force));
    }
    safety
}

#[test]
fn complete_means_complete() {
    let full = SafetyConfig::for_device(&info(), 1000.0);
    for device in [VirtualConfig::touch(), VirtualConfig::default()].map(|c| c.info()) {
        for rate in [500.0, 1000.0, 8000.0] {
            assert_eq!(
                SafetyConfig::for_device(&device, rate).check(&device, rate),
                Ok(()),
                "{}",
                device.name
            );
        }
    }
    let check = |config: SafetyConfig| config.check(&info(), 1000.0);
    assert_eq!(check(SafetyConfig::bare()), Err(SafetyError::Missing("passivity")));
    assert_eq!(check(SafetyConfig { slew: None, ..full }), Err(SafetyError::Missing("slew")));
    let above = SafetyError::OutOfBounds { what: "peak", least: f64::MIN_POSITIVE, most: 3.3, got: 100.0 };
    assert_eq!(check(SafetyConfig { peak: Some(100.0), ..full }), Err(above), "above the device's peak");
    let nan = check(SafetyConfig { ramp: Some(f64::NAN), ..full });
    assert!(matches!(nan, Err(SafetyError::OutOfBounds { what: "ramp", .. })), "{nan:?}");
}

#[test]
fn magnitude_is_clamped_and_direction_kept() {
    let mut safety = engaged(0.0);
    let mut out = safety.tick(&wanted(0.0));
    for _ in 0..20 {
        out = safety.tick(&Wanted { elastic: Vector3::new(30.0, 40.0, 0.0), ..wanted(0.0) });
    }
    assert!((out.force.norm() - 3.3).abs() < 1e-9, "{}", out.force);
    assert!((out.force.y / out.force.x - 4.0 / 3.0).abs() < 1e-9);
}

#[test]
fn slew_holds_whatever_happens() {
    // Full force back and forth, a fault, a stale model and a fast hand come at once. No step may
    // exceed the limit, except that of the emergency stop.
    let config = SafetyConfig::for_device(&info(), 1000.0);
    let most = config.slew.unwrap() * 1e-3;
    let mut safety = engaged(3.0);
    let mut last = safety.force();
    for k in 0..2000u32 {
        let mut w = wanted(if (k / 3).is_multiple_of(2) { 9.0 } else { -9.0 });
        w.fault = (k % 97 > 80).then_some(Fault::NotFinite);
        w.silent = if k % 401 > 340 { f64::from(k % 401 - 340) * 1e-3 } else { 0.0 };
        w.velocity.y = if k % 211 > 200 { 3.0 } else { 0.0 };
        let out = safety.tick(&w);
        assert!((out.force - last).norm() <= most * (1.0 + 1e-12), "tick {k}: {} after {last}", out.force);
        last = out.force;
    }
}

#[test]
fn not_finite_is_no_force() {
    let mut safety = engaged(1.0);
    let before = safety.force().norm();
    assert!(before > 0.99);
    let mut last = before;
    for k in 0..25 {
        let out = safety.tick(&wanted(f64::NAN));
        assert_eq!(out.fault, Some(Fault::BadModel));
        assert!(
            out.force.norm() <= last && out.force.iter().all(|x| x.is_finite()),
            "tick {k}: {}",
            out.force
        );
        last = out.force.norm();
    }
    assert_eq!(last, 0.0);
}

#[test]
fn no_number_poisons_the_pipeline() {
    let huge = Vector3::new(1e200, -1e200, 1e-3);
    let nan = Vector3::new(f64::NAN, 0.0, 0.0);
    let poisons: [(&str, fn(&mut Wanted, Vector3<f64>)); 7] = [
        ("velocity", |w, v| w.velocity = v),
        ("moved", |w, v| w.moved = v),
        ("elastic", |w, v| w.elastic = v),
        ("damping", |w, v| w.damping = v),
        ("energies", |w, v| (w.stored, w.supplied) = (v.x, v.y)),
        ("silence", |w, v| w.silent = v.x),
        // A long period is valid and heats the motors, so this case tests negative periods only.
        ("period", |w, v| w.dt = if v.x.is_finite() { -v.x.abs() } else { v.x }),
    ];
    for (what, poison) in poisons {
        for value in [huge, -huge, nan, Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::MAX)] {
            let mut safety = engaged(1.0);
            // Both cases are covered: with leaked energy to damp away, and without.
            safety.tick(&Wanted { moved: Vector3::new(2e-3, 0.0, 0.0), ..wanted(1.0) });
            for _ in 0..3 {
                let mut w = wanted(1.0);
                poison(&mut w, value);
                let out = safety.tick(&w);
                assert!(
                    is_finite(&out.force) && out.force.norm() <= 3.3,
                    "{what} {value:?}: {:?}",
                    out.force
                );
            }
            // The next grab recovers, whatever was counted in this one.
            safety.tick(&Wanted { holding: false, ..wanted(0.0) });
            let out = (0..1500).map(|_| safety.tick(&wanted(1.0))).last().unwrap();
            assert!((out.force.x - 1.0).abs() < 1e-6, "{what} {value:?}: {:?} N", out.force);
            let out = safety.tick(&Wanted { stop: true, ..wanted(1.0) });
            assert_eq!(out.force, Vector3::zeros(), "{what} {value:?}");
            assert!(out.force.iter().all(|x| x.is_sign_positive()), "exactly nothing: {}", out.force);
        }
    }
}

#[test]
fn thermal_budget_ends_at_the_continuous_force() {
    let config = ThermalConfig { continuous: 1.0, peak_seconds: 5.0 };
    let mut thermal = Thermal::default();
    let mut at_peak = 0;
    let mut last = 3.0;
    for k in 0..60_000 {
        let limit = thermal.limit(&config, 3.0);
        assert!(limit <= last + 1e-12);
        last = limit;
        at_peak += i32::from(limit > 3.0 - 1e-9);
        thermal.heat(&config, 3.0, limit, 1e-3);
        assert!(
            k < 59_999 || (limit - 1.0).abs() < 0.01,
            "a minute of pushing ends at what is borne for ever: {limit}"
        );
    }
    // Half of the budget lasts 2.5 s at full force.
    assert!((2490..=2510).contains(&at_peak), "{at_peak}");
    // The motors cool: the margin is 1 N^2 against 40 N^2 s.
    for _ in 0..60_000 {
        thermal.heat(&config, 3.0, 0.0, 1e-3);
    }
    assert_eq!(thermal.limit(&config, 3.0), 3.0);
}

#[test]
fn ramp_takes_its_time_and_every_fault_ramps_back() {
    let mut safety = Safety::new(SafetyConfig::for_device(&info(), 1000.0), 0.045);
    let out = (0..150).map(|_| safety.tick(&wanted(1.0))).last().unwrap();
    assert!((out.gain - 0.5).abs() < 0.01, "half of 300 ms: {}", out.gain);
    let mut safety = engaged(1.0);
    let faulty = Wanted { fault: Some(Fault::Timeout(0.1)), ..wanted(1.0) };
    let out = (0..20).map(|_| safety.tick(&faulty)).last().unwrap();
    assert!(out.gain < 1e-9, "faded within 20 ms: {}", out.gain);
    let out = safety.tick(&wanted(1.0));
    assert!(out.gain < 0.01, "no jump back: {}", out.gain);
    let out = (0..150).map(|_| safety.tick(&wanted(1.0))).last().unwrap();
    assert!((out.gain - 0.5).abs() < 0.01, "{}", out.gain);
}

#[test]
fn stale_model_fades_in_fifty_milliseconds() {
    let mut safety = engaged(1.0);
    for k in 0..=60 {
        let silent = f64::from(k) * 1e-3;
        let out = safety.tick(&Wanted { silent, ..wanted(1.0) });
        match k {
            0..=30 => assert_eq!(out.gain, 1.0, "at {k} ms"),
            50.. => assert_eq!(out.gain, 0.0, "at {k} ms"),
            _ => assert!(out.gain < 1.0 && matches!(out.fault, Some(Fault::Stale(_)))),
        }
    }
    let out = safety.tick(&wanted(1.0));
    assert!(out.gain < 0.01, "comes back by the ramp: {}", out.gain);
}

#[test]
fn fast_hands_are_let_go_with_hysteresis() {
    let mut safety = engaged(1.0);
    let at = |speed: f64| Wanted { velocity: Vector3::new(0.0, speed, 0.0), ..wanted(1.0) };
    for _ in 0..30 {
        safety.tick(&at(2.0));
    }
    assert_eq!(safety.force().norm(), 0.0);
    let out = (0..500).map(|_| safety.tick(&at(1.0))).last().unwrap();
    assert!(matches!(out.fault, Some(Fault::TooFast(_))) && out.gain == 0.0, "not slow enough yet");
    let out = (0..500).map(|_| safety.tick(&at(0.5))).last().unwrap();
    assert_eq!(out.gain, 1.0);
}

#[test]
fn emergency_stop_cuts_and_stays() {
    let mut safety = engaged(3.0);
    assert!(safety.force().norm() > 2.9);
    let out = safety.tick(&Wanted { stop: true, ..wanted(3.0) });
    assert_eq!(out.force, Vector3::zeros(), "in one tick");
    for _ in 0..5000 {
        assert_eq!(safety.tick(&wanted(3.0)).force, Vector3::zeros(), "latched");
    }
    safety.reset_stop();
    let out = safety.tick(&wanted(3.0));
    assert!(out.gain < 0.01 && out.fault.is_none(), "ramps after the reset");
}

#[test]
fn energy_of_a_held_force_is_exact() {
    let mut p =
        Passivity::new(PassivityConfig { tank: 0.01, max_damping: 5.0, ..PassivityConfig::default() });
    let mut sum = 0.0;
    for k in 0..100 {
        let f = Vector3::new((f64::from(k) * 0.7).sin(), 1.0, -0.5);
        let dx = Vector3::new(0.001, (f64::from(k) * 0.3).cos() * 1e-3, 0.0);
        sum += f.dot(&dx);
        p.observe(&f, &dx, 0.0, 1e9, false, true);
    }
    let port = p.port();
    assert!((port.available - (0.01 - sum)).abs() < 1e-15);
    assert!((port.given - port.taken - sum).abs() < 1e-15);
    // Energy that cannot be stored is not credited. The hand puts in 1 J, and what remains is the
    // tank and the 2 mJ of the spring.
    p.observe(&Vector3::new(-1.0, 0.0, 0.0), &Vector3::new(1.0, 0.0, 0.0), 0.0, 0.002, false, true);
    assert!((p.port().available - 0.012).abs() < 1e-15);
    // If the stored energy is known only in part, the whole input is credited to the hand.
    p.observe(&Vector3::new(-1.0, 0.0, 0.0), &Vector3::new(1.0, 0.0, 0.0), 0.0, 0.002, true, true);
    assert!((p.port().available - 1.012).abs() < 1e-15);
}

#[test]
fn no_more_comes_out_than_went_in_plus_the_tank() {
    // A constant force carries a hand along at 0.5 m/s. The hand receives at most the energy of the
    // tank.
    let tank = 0.005;
    let config = SafetyConfig::for_device(&info(), 1000.0);
    let mut safety = Safety::new(SafetyConfig { ramp: Some(1e-3), ..config }, 0.045);
    let velocity = Vector3::new(0.5, 0.0, 0.0);
    let mut given = 0.0;
    let mut last = Vector3::zeros();
    for _ in 0..1000 {
        let moved = velocity * 1e-3;
        given += last.dot(&moved);
        let out = safety.tick(&Wanted { moved, velocity, stored: 0.0, ..wanted(3.0) });
        last = out.force;
        assert!(given <= tank, "{given} J");
    }
    assert!(given > 0.3 * tank, "and most of the tank it does get: {given} J");
}

#[test]
fn a_spring_stretched_in_a_fade_is_felt_again_by_a_hand_that_rests() {
    // While the local model is faulty, a hand stretches a spring to 3 N and 30 mJ, and then rests.
    // The hand felt no force, so at most the tank is available. The force still comes back, at most
    // at the power of the repayment.
    let config = PassivityConfig::default();
    let mut safety = Safety::new(SafetyConfig::for_device(&info(), 1000.0), 0.045);
    let rests = || Wanted { stored: 0.03, ..wanted(3.0) };
    for _ in 0..1000 {
        safety.tick(&Wanted { stored: 0.0, ..wanted(0.0) });
    }
    for k in 0..100 {
        let share = f64::from(k) / 100.0;
        let moved = Vector3::new(-2e-4, 0.0, 0.0);
        let stretching = Wanted { moved, stored: 0.03 * share * share, ..wanted(3.0 * share) };
        safety.tick(&Wanted { fault: Some(Fault::BadModel), ..stretching });
    }
    // A hand that is carried along spends the energy of the tank that is left after the fade: 3 N
    // over 1.6 mm.
    let mut port = Port::default();
    let mut spent = 0.0;
    let mut last = Vector3::zeros();
    while spent < 0.0049 && port.given < 1.0 {
        let moved = Vector3::new(1e-5, 0.0, 0.0);
        spent += last.dot(&moved);
        let out = safety.tick(&Wanted { moved, ..rests() });
        (last, port) = (out.force, out.port);
    }
    let before = port.repaid;
    let mut out = safety.tick(&rests());
    for _ in 0..700 {
        out = safety.tick(&rests());
    }
    assert!((out.force.x - 3.0).abs() < 1e-9, "{} N of 3", out.force.x);
    let repaid = out.port.repaid - before;
    assert!(repaid > 0.0 && repaid <= config.repay * 0.702 && repaid <= config.tank, "{repaid} J");
    assert!(out.port.available <= config.tank + 1e-12);
}

#[test]
fn across_a_push_the_controller_brakes_no_harder_than_it_pushes() {
    // A hand that was given more energy than there was leaves a surface: it is hardly pushed any
    // more, and moves along the surface.
    let braked = |one_sided: bool| {
        let mut safety = engaged(1.0);
        let given = Wanted {
            moved: Vector3::new(2e-4, 0.0, 0.0),
            velocity: Vector3::new(0.2, 0.0, 0.0),
            ..wanted(1.0)
        };
        for _ in 0..200 {
            safety.tick(&given);
        }
        let leaving = Wanted {
            moved: Vector3::new(0.0, 2e-4, 0.0),
            velocity: Vector3::new(0.0, 0.2, 0.0),
            one_sided,
            ..wanted(1e-3)
        };
        let ticks = (0..200).map(|_| safety.tick(&leaving).force);
        ticks.map(|force| force.y.abs()).fold(0.0, f64::max)
    };
    let [free, one_sided] = [false, true].map(braked);
    assert!(free > 5e-3, "there is a debt to brake for: {free} N");
    assert!(one_sided <= 1.001e-3, "{one_sided} N across a push of 1 mN");
}
