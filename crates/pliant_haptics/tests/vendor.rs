//! Fake vendor libraries. The test builds them with the system's C compiler, which the workspace
//! needs anyway.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#![cfg(all(feature = "vendor", unix))]
#![allow(unsafe_code, reason = "the fake libraries are steered through C functions")]

use std::{
    ffi::{CString, c_char, c_int, c_uint, c_ulong},
    path::Path,
    time::Duration,
};

use fakes::{ONE_HD, dhd, fake, force, hd, open_fake, place};
use pliant_haptics::{
    Calibration, Cycle, Fault, ForceDimension, ForceDimensionConfig, HapticDevice, LocalModel, LoopClock,
    LoopConfig, LoopEvent, LoopState, OpenHaptics, OpenHapticsConfig, Period, RealScheduler, Scheduler,
    VendorError, Wrench,
};

#[path = "rig/fakes.rs"]
#[macro_use]
mod fakes;
#[path = "rig/machine.rs"]
mod machine;

fn pacing() -> RealScheduler {
    RealScheduler::new(LoopClock::start(), 1000.0)
}

/// Virtual time of a device that does the timing: an exchange takes 10 us, and a wait ends on time.
#[derive(Default)]
struct Quick(Period);

impl Scheduler for Quick {
    fn wait(&mut self) -> Period {
        self.0 = Period { now: self.0.now + 1e-3, dt: 1e-3, ..Period::default() };
        self.0
    }

    fn last(&self) -> Period {
        self.0
    }

    fn note(&mut self) -> Period {
        self.0 = Period { now: self.0.now + 10e-6, dt: 10e-6, ..Period::default() };
        self.0
    }
}

/// Tries at most 100 times. Each try passes virtual time.
fn until(what: &str, so: &mut dyn FnMut() -> bool) {
    assert!((0..100).any(|_| so()), "never: {what}");
}

#[test]
fn open_haptics_units_axes_and_sizes() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let path = fake("hd", "units", &[]);
    let library = open_fake(&path);
    assert_eq!(call!(library, "fake_error_size", fn() -> c_ulong,), 12, "HDErrorInfo");
    // The C compiler lays the published declaration out as the driver does.
    let offsets = call!(library, "fake_error_offsets", fn() -> c_ulong,);
    assert_eq!(offsets, 4 << 8 | 8 << 16, "errorCode, internalErrorCode, hHD");
    assert_eq!(call!(library, "fake_boolean_size", fn() -> c_ulong,), 1, "HDboolean");
    assert_eq!(call!(library, "fake_long_size", fn() -> c_ulong,) as usize, size_of::<c_ulong>(), "HDulong");
    let mut device = OpenHaptics::open(hd(&path)).unwrap();
    let info = device.info();
    assert_eq!((info.name.as_str(), info.serial.as_str()), ("Fake Omni", "0042"));
    // The library reports 0.7 N/mm and 0.005 N s/mm.
    assert!((info.max_stiffness - 700.0).abs() < 1e-9 && (info.max_damping - 5.0).abs() < 1e-9, "{info:?}");
    assert_eq!((info.peak_force, info.continuous_force), (3.3, 0.88));
    assert_eq!(info.workspace, [[-0.08, -0.06, -0.035], [0.08, 0.06, 0.035]]);
    assert!(!info.simulated && info.check().is_ok());
    assert_eq!(device.calibration(), Calibration::Ready);
    // With two devices, each one is queried itself, whichever was queried last.
    call!(library, "fake_calibration", fn(c_int), 0x5002);
    call!(library, "fake_another_is_current", fn(),);
    assert_eq!(device.calibration(), Calibration::Needed("put the stylus into its inkwell"));
    call!(library, "fake_calibration", fn(c_int), 0x5001);
    call!(library, "fake_another_is_current", fn(),);
    assert_eq!(device.calibration(), Calibration::Ready, "it only needed to be told");

    place(&library, [10.0, -20.0, 30.0], 250.0);
    call!(library, "fake_buttons", fn(c_int), 0b10);
    call!(library, "fake_quarter_turn", fn(),);
    let sample = device.exchange(&Wrench { force: [0.5, -1.0, 1.5], ..Wrench::ZERO }, &mut pacing()).unwrap();
    assert_eq!(force(&library), [0.5, -1.0, 1.5]);
    for (got, want) in sample.position.into_iter().zip([0.01, -0.02, 0.03]) {
        assert!((got - want).abs() < 1e-15);
    }
    assert_eq!(sample.velocity, Some([0.25, 0.0, 0.0]));
    assert_eq!(sample.buttons, 0b10);
    let half = std::f64::consts::FRAC_1_SQRT_2;
    for (got, want) in sample.orientation.into_iter().zip([half, 0.0, 0.0, half]) {
        assert!((got - want).abs() < 1e-12, "{:?}", sample.orientation);
    }
    drop(device);
    assert_eq!(force(&library), [0.0; 3], "no force is left behind");
    assert_eq!(call!(library, "fake_running", fn() -> c_int,), 0);
    assert_eq!(call!(library, "fake_open", fn() -> c_int,), 0);
}

#[test]
fn open_haptics_calibration_fault_and_return() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let path = fake("hd", "faults", &[]);
    let library = open_fake(&path);
    // The calibration needs the user's hand.
    call!(library, "fake_calibration", fn(c_int), 0x5002);
    let device = OpenHaptics::open(hd(&path)).unwrap();
    let mut cycle = Cycle::new(device, LoopConfig::default()).unwrap();
    let mut events: Vec<LoopEvent> = Vec::new();
    let mut scheduler = Quick::default();
    let mut model = LocalModel { count: 1, period: 0.01, ..LocalModel::default() };
    model.contacts[0].stiffness = [[100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]];
    place(&library, [5.0, 0.0, 0.0], 0.0);
    let mut ticks = 0;
    let mut run = |cycle: &mut Cycle<OpenHaptics>, events: &mut Vec<LoopEvent>, seconds: f64| {
        let start = (scheduler.last().now, ticks);
        let until = scheduler.last().now + seconds;
        while scheduler.last().now < until {
            model.tick += 1;
            // The real scheduler waits for its servo tick. The fake does not wait, and the loop
            // must not spin on it.
            cycle.step(&mut scheduler, &model, events);
            ticks += 1;
        }
        let rate = f64::from(ticks - start.1) / (scheduler.last().now - start.0);
        assert!(rate < 2500.0, "at most every other period is short: {rate} Hz");
    };
    run(&mut cycle, &mut events, 0.1);
    assert!(events.contains(&LoopEvent::Calibrate("put the stylus into its inkwell")), "{events:?}");
    assert_eq!((cycle.report().state, force(&library)), (LoopState::Calibrating, [0.0; 3]));
    // This calibration needs only a call to the library.
    call!(library, "fake_calibration", fn(c_int), 0x5001);
    until("100 N/m over 5 mm", &mut || {
        run(&mut cycle, &mut events, 0.1);
        (force(&library)[0] + 0.5).abs() < 1e-6
    });
    assert_eq!(cycle.report().state, LoopState::Running);
    // The driver returns a fault each frame. The force fades within 20 ms, the device counts as
    // lost after 100 ms, and then it comes back.
    call!(library, "fake_error", fn(c_uint), 0x302);
    until("no force", &mut || {
        run(&mut cycle, &mut events, 0.03);
        force(&library)[0].abs() < 1e-9
    });
    assert!(events.contains(&LoopEvent::Fault(Fault::Driver(0x302))), "{events:?}");
    until("lost", &mut || {
        run(&mut cycle, &mut events, 0.1);
        events.contains(&LoopEvent::Lost)
    });
    call!(library, "fake_error", fn(c_uint), 0);
    until("back, with all its force", &mut || {
        run(&mut cycle, &mut events, 0.1);
        events.contains(&LoopEvent::Returned) && (force(&library)[0] + 0.5).abs() < 1e-6
    });
}

/// Sends 1 N, and 1 N again after a pause that is too long for the device's watchdog.
fn renewed_late(device: &mut dyn HapticDevice, force: impl Fn() -> [f64; 3]) {
    let pull = Wrench { force: [1.0, 0.0, 0.0], ..Wrench::ZERO };
    let pulls = |device: &mut dyn HapticDevice| {
        machine::until("1 N on the motors", || {
            let sample = device.exchange(&pull, &mut pacing());
            if sample.is_ok_and(|s| s.force_on) && force() != [0.0; 3] { Ok(()) } else { Err(sample) }
        });
    };
    pulls(device);
    std::thread::sleep(Duration::from_millis(40));
    let late = device.exchange(&pull, &mut pacing()).unwrap();
    let sent = force();
    println!("{}: {sent:?} N after a late renewal", device.info().name);
    assert_eq!((sent, late.force_on), ([0.0; 3], false), "a force that may be off comes back at zero");
    pulls(device);
}

#[test]
fn a_late_renewal_sends_zero_first() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let path = fake("hd", "late", &[]);
    let library = open_fake(&path);
    renewed_late(&mut OpenHaptics::open(hd(&path)).unwrap(), || force(&library));
    // Without its own watchdog, the fake obeys whatever it is sent.
    let path = fake("dhd", "late", &["-DWITHOUT_WATCHDOG"]);
    let library = open_fake(&path);
    renewed_late(&mut ForceDimension::open(dhd(&path)).unwrap(), || force(&library));
}

#[test]
fn open_haptics_takes_all_errors_at_once_and_switches_the_force_off_on_its_way_out() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let path = fake("hd", "errors", &[]);
    let library = open_fake(&path);
    let mut device = OpenHaptics::open(hd(&path)).unwrap();
    let mut scheduler = Quick::default();
    assert!(device.exchange(&Wrench::ZERO, &mut scheduler).is_ok());
    call!(library, "fake_error_count", fn(c_int), 5);
    call!(library, "fake_error", fn(c_uint), 0x302);
    assert_eq!(device.exchange(&Wrench::ZERO, &mut scheduler), Err(Fault::Driver(0x302)));
    // Of several errors the oldest is told, which the library returns last.
    call!(library, "fake_first_error", fn(c_uint), 0x303);
    assert_eq!(device.exchange(&Wrench::ZERO, &mut scheduler), Err(Fault::Driver(0x303)));
    call!(library, "fake_first_error", fn(c_uint), 0);
    call!(library, "fake_error", fn(c_uint), 0);
    let next = device.exchange(&Wrench::ZERO, &mut scheduler);
    assert!(next.is_ok(), "one bad frame is one error: {next:?}");
    assert_eq!(call!(library, "fake_errors_left", fn() -> c_int,), 0);
    assert_eq!(call!(library, "fake_disabled", fn() -> c_int,), 0);
    drop(device);
    assert_eq!(call!(library, "fake_disabled", fn() -> c_int,), 1, "hdDisable(HD_FORCE_OUTPUT)");
    assert_eq!(call!(library, "fake_open", fn() -> c_int,), 0);
}

#[test]
fn open_haptics_refuses_other_libraries() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let nowhere = OpenHaptics::open(hd(Path::new("/nowhere/libHD.so")));
    assert!(matches!(nowhere, Err(VendorError::Library { .. })), "{nowhere:?}");
    let path = fake("hd", "partial", &["-DWITHOUT_SCHEDULER"]);
    let partial = OpenHaptics::open(hd(&path));
    assert!(
        matches!(partial, Err(VendorError::Symbol { symbol: "hdScheduleSynchronous", .. })),
        "{partial:?}"
    );
    let path = fake("hd", "old", &[]);
    let library = open_fake(&path);
    let old = CString::new("2.0.1").unwrap();
    call!(library, "fake_version", fn(*const c_char), old.as_ptr());
    let refused = OpenHaptics::open(hd(&path));
    assert!(matches!(refused, Err(VendorError::Version { .. })), "{refused:?}");
    assert_eq!(call!(library, "fake_open", fn() -> c_int,), 0, "and closes what it had opened");
    let unknown = OpenHapticsConfig { device: Some("Right Device".into()), ..hd(&path) };
    let unknown = OpenHaptics::open(unknown);
    assert!(matches!(unknown, Err(VendorError::Device { code: 0x300, .. })), "{unknown:?}");
}

#[test]
fn force_dimension_units_and_axes() {
    let path = fake("dhd", "units", &[]);
    let library = open_fake(&path);
    assert_eq!(ForceDimension::count(&dhd(&path)).unwrap(), 1);
    let mut device = ForceDimension::open(dhd(&path)).unwrap();
    let info = device.info();
    assert_eq!((info.name.as_str(), info.serial.as_str(), info.peak_force), ("omega.6", "1234", 12.0));
    assert!(info.check().is_ok());
    // The position is 1 cm toward the user, 2 cm right, 3 cm up.
    place(&library, [0.01, 0.02, 0.03], 0.5);
    call!(library, "fake_turn_up", fn(),);
    let sample = device.exchange(&Wrench { force: [1.0, 2.0, 3.0], ..Wrench::ZERO }, &mut pacing()).unwrap();
    assert_eq!(sample.position, [0.02, 0.03, 0.01]);
    assert_eq!(sample.velocity, Some([0.0, 0.0, 0.5]));
    // A force of 1 N right, 2 N up, 3 N toward the user is (3, 1, 2) in the vendor's axes.
    assert_eq!(force(&library), [3.0, 1.0, 2.0]);
    // A quarter turn about the vendor's z axis is one about Bevy's y axis.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    for (got, want) in sample.orientation.into_iter().zip([0.0, half, 0.0, half]) {
        assert!((got - want).abs() < 1e-12, "{:?}", sample.orientation);
    }
    drop(device);
    assert_eq!(force(&library), [0.0; 3]);
    assert_eq!(call!(library, "fake_open", fn() -> c_int,), 0);
}

#[test]
fn force_dimension_faults_and_versions() {
    let path = fake("dhd", "faults", &[]);
    let library = open_fake(&path);
    let mut device = ForceDimension::open(dhd(&path)).unwrap();
    call!(library, "fake_reset", fn(c_int), 0);
    assert!(matches!(device.calibration(), Calibration::Needed(_)));
    call!(library, "fake_reset", fn(c_int), 1);
    assert_eq!(device.calibration(), Calibration::Ready);
    let mut scheduler = pacing();
    call!(library, "fake_gone", fn(c_int), 1);
    assert_eq!(device.exchange(&Wrench::ZERO, &mut scheduler).unwrap_err(), Fault::Driver(1009));
    assert_eq!(device.reopen().unwrap_err(), Fault::Gone);
    assert_eq!(device.exchange(&Wrench::ZERO, &mut scheduler).unwrap_err(), Fault::Gone);
    call!(library, "fake_gone", fn(c_int), 0);
    assert!(device.reopen().is_ok());
    assert!(device.exchange(&Wrench::ZERO, &mut scheduler).is_ok());
    drop(device);
    let absent = ForceDimension::open(ForceDimensionConfig { index: 3, ..dhd(&path) });
    assert!(matches!(absent, Err(VendorError::Device { code: 1003, .. })), "{absent:?}");
    call!(library, "fake_major", fn(c_int), 2);
    let old = ForceDimension::open(dhd(&path));
    assert!(matches!(old, Err(VendorError::Version { .. })), "{old:?}");
}

#[test]
fn force_dimension_finds_its_reference_by_itself_if_it_is_told_to() {
    let path = fake("dhd", "plain", &[]);
    let auto_init_config = |path: &Path| ForceDimensionConfig { auto_init: true, ..dhd(path) };
    let plain = ForceDimension::open(auto_init_config(&path));
    assert!(matches!(plain, Err(VendorError::Symbol { symbol: "drdOpenID", .. })), "{plain:?}");
    let path = fake("dhd", "robotic", &["-DWITH_DRD"]);
    let library = open_fake(&path);
    let drives = || call!(library, "fake_drives", fn() -> c_int,);
    // Without the setting, the device does not move by itself.
    call!(library, "fake_reset", fn(c_int), 0);
    let mut device = ForceDimension::open(dhd(&path)).unwrap();
    assert!(matches!(device.calibration(), Calibration::Needed(_)));
    drop(device);
    assert_eq!(drives(), 0);
    // With the setting, the device moves once. The library's own control loop has then ended, and
    // the forces are enabled.
    let mut device = ForceDimension::open(auto_init_config(&path)).unwrap();
    assert_eq!((drives(), device.calibration()), (1, Calibration::Ready));
    assert_eq!(call!(library, "fake_driving", fn() -> c_int,), 0);
    assert_eq!(call!(library, "fake_enabled", fn() -> c_int,), 1);
    assert!(device.exchange(&Wrench { force: [1.0, 2.0, 3.0], ..Wrench::ZERO }, &mut pacing()).is_ok());
    assert_eq!(force(&library), [3.0, 1.0, 2.0]);
    // After it was unplugged and plugged in, the device has forgotten its position and finds it
    // again.
    call!(library, "fake_gone", fn(c_int), 1);
    assert!(device.exchange(&Wrench::ZERO, &mut pacing()).is_err());
    call!(library, "fake_reset", fn(c_int), 0);
    call!(library, "fake_gone", fn(c_int), 0);
    assert!(device.reopen().is_ok());
    assert_eq!((drives(), device.calibration()), (2, Calibration::Ready));
    drop(device);
    // A device that knows its position does not move. A device that cannot move is refused and
    // closed.
    drop(ForceDimension::open(auto_init_config(&path)).unwrap());
    assert_eq!(drives(), 2);
    call!(library, "fake_reset", fn(c_int), 0);
    call!(library, "fake_stuck", fn(c_int), 1);
    let stuck = ForceDimension::open(auto_init_config(&path));
    assert!(matches!(stuck, Err(VendorError::Device { what: "drdAutoInit", code: 1008, .. })), "{stuck:?}");
    assert_eq!(call!(library, "fake_driving", fn() -> c_int,), 0);
    assert_eq!(call!(library, "fake_open", fn() -> c_int,), 0);
}

#[test]
fn what_is_plugged_in_is_found() {
    use pliant_haptics::{FindConfig, Found, find_devices};
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    #[cfg(feature = "inverse")]
    let nobody = machine::Nobody::new();
    let nowhere = FindConfig {
        open_haptics: hd(Path::new("/nowhere/libHD.so")),
        force_dimension: dhd(Path::new("/nowhere/libdhd.so")),
        #[cfg(feature = "inverse")]
        inverse: pliant_haptics::InverseConfig { address: nobody.address.clone(), ..Default::default() },
    };
    assert_eq!(find_devices(&nowhere), [Found::Virtual], "the simulated one always is");
    assert!(Found::Virtual.open().unwrap().info().simulated);
    let (hd_path, dhd_path) = (fake("hd", "find", &[]), fake("dhd", "find", &[]));
    let mut somewhere = nowhere;
    somewhere.open_haptics = hd(&hd_path);
    somewhere.force_dimension = dhd(&dhd_path);
    let found = find_devices(&somewhere);
    assert_eq!(found.len(), 3);
    let names: Vec<_> = found.iter().map(|f| f.open().unwrap().info().name).collect();
    assert_eq!(names, ["Fake Omni", "omega.6", "virtual Touch"]);
}
