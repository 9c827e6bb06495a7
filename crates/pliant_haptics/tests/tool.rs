//! Behavior of a tool with held patches: torque from several grabs, masks, scales, weight, a body
//! that is stepped elsewhere, two devices.

use pliant_haptics::{
    Coupling, DeviceInfo, HandModel, HapticDevice, LocalModel, LoopConfig, LoopCore, ModelWriter,
    PublishedGrab, Sample, ToolContact, ToolMap, VirtualConfig, VirtualDevice,
};

use crate::rig::machine;

/// Returns a device of six degrees of freedom that the test moves.
fn six() -> DeviceInfo {
    DeviceInfo { peak_torque: 0.5, torque_axes: [true; 3], resolution: 0.0, ..VirtualConfig::touch().info() }
}

fn spring(offset: [f64; 3], proxy: [f64; 3], k: f64) -> ToolContact {
    ToolContact {
        offset,
        proxy,
        stiffness: [[k, 0.0, 0.0], [0.0, k, 0.0], [0.0, 0.0, k]],
        ..ToolContact::default()
    }
}

/// Holds the device still at `sample` until the ramp and the slew are over.
fn step_to_rest(core: &mut LoopCore, sample: &Sample, contacts: &[ToolContact]) -> ([f64; 3], [f64; 3]) {
    let mut model = LocalModel { period: 0.01, count: contacts.len(), ..LocalModel::default() };
    model.contacts[..contacts.len()].copy_from_slice(contacts);
    let mut now = core.last().now;
    for k in 0..600u64 {
        now += 1e-3;
        model.tick = core.last().now.to_bits() + k;
        core.tick(now, 1e-3, &Sample { sequence: Some(k), ..*sample }, &model);
    }
    (core.last().wrench.force, core.last().wrench.torque)
}

fn near(got: [f64; 3], want: [f64; 3], what: &str) {
    for (g, w) in got.into_iter().zip(want) {
        assert!((g - w).abs() < 1e-6, "{what}: {got:?} for {want:?}");
    }
}

#[test]
fn two_grabs_on_a_tool_turn_it() {
    let mut core = LoopCore::new(six(), LoopConfig::default()).unwrap();
    // The grabs form a couple: they are held 5 cm to either side, with one proxy 1 cm up and the
    // other 1 cm down. F = 100 N/m x 1 cm = 1 N, and the torque is 2 x 0.05 m x 1 N about z.
    let right = spring([0.05, 0.0, 0.0], [0.05, 0.01, 0.0], 100.0);
    let left = spring([-0.05, 0.0, 0.0], [-0.05, -0.01, 0.0], 100.0);
    let (force, torque) = step_to_rest(&mut core, &Sample::default(), &[right, left]);
    near(force, [0.0; 3], "no force in sum");
    near(torque, [0.0, 0.0, 0.1], "a couple about z");
    // The device has no motor for that axis.
    let blind = DeviceInfo { torque_axes: [true, true, false], ..six() };
    let mut core = LoopCore::new(blind, LoopConfig::default()).unwrap();
    near(step_to_rest(&mut core, &Sample::default(), &[right, left]).1, [0.0; 3], "masked");
    // A torque above the motors' peak is clamped.
    let mut core = LoopCore::new(six(), LoopConfig::default()).unwrap();
    let strong = |c: ToolContact| ToolContact { stiffness: c.stiffness.map(|r| r.map(|x| 50.0 * x)), ..c };
    near(
        step_to_rest(&mut core, &Sample::default(), &[strong(right), strong(left)]).1,
        [0.0, 0.0, 0.5],
        "clamped",
    );
}

#[test]
fn a_torque_is_cut_as_its_force_is_and_real_motors_get_none() {
    // The spring wants 10 N on an arm of 5 cm, but the device gives 3.3 N. The torque is therefore
    // 0.165 N m and not the motors' 0.5 N m.
    let pull = spring([0.05, 0.0, 0.0], [0.05, 0.01, 0.0], 1000.0);
    let mut core = LoopCore::new(six(), LoopConfig::default()).unwrap();
    let (force, torque) = step_to_rest(&mut core, &Sample::default(), &[pull]);
    near(force, [0.0, 3.3, 0.0], "the peak");
    near(torque, [0.0, 0.0, 0.05 * 3.3], "and its torque");
    // An emergency stop cuts both in one tick.
    core.emergency_stop();
    let now = core.last().now + 1e-3;
    let stopped = core.tick(
        now,
        1e-3,
        &Sample { sequence: Some(1 << 40), ..Sample::default() },
        &LocalModel::default(),
    );
    assert_eq!(stopped, pliant_haptics::Wrench::ZERO);
    // The stability of a handle that a stiff spring turns is not proven, so the loop does not drive
    // the torque motors of real devices.
    let real = DeviceInfo { simulated: false, ..six() };
    let mut core = LoopCore::new(real, LoopConfig::default()).unwrap();
    let (force, torque) = step_to_rest(&mut core, &Sample::default(), &[pull]);
    near(force, [0.0, 3.3, 0.0], "the force is felt");
    assert_eq!(torque, [0.0; 3]);
}

#[test]
fn scale_masks_and_weight() {
    let half = std::f64::consts::FRAC_1_SQRT_2;
    // The tool has twice the motion, half the force and a quarter turn about z: the device's x axis
    // is the world's y axis.
    let tool = ToolMap {
        rotation: [0.0, 0.0, half, half],
        motion_scale: 2.0,
        force_scale: 0.5,
        force_axes: [true, true, false],
        mass: 0.05,
        ..ToolMap::default()
    };
    let mut core = LoopCore::new(six(), LoopConfig { tool, ..LoopConfig::default() }).unwrap();
    let sample = Sample::at([0.005, 0.0, 0.01]);
    let (force, _) = step_to_rest(&mut core, &sample, &[spring([0.0; 3], [0.0; 3], 100.0)]);
    // 1 cm along y in the world gives 1 N, times 2 x 0.5 at the hand. The mass of 50 g pulls down.
    near(force, [-1.0, -0.05 * 9.806_65, 0.0], "scaled, masked and weighed");
    let tool = core.last().tool;
    near(tool, [0.0, 0.01, 0.02], "the tool in the world");
}

#[test]
fn a_body_elsewhere_is_felt_through_what_is_published() {
    // The body is stepped elsewhere, and its point and force come over the network.
    let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::NONE).unwrap();
    let config = LoopConfig::default();
    let coupling = Coupling::clamp(&config.coupling, &device.info(), config.rate, 0.0, 0.0);
    let grab = coupling.grab_config(1.0, 1.0);
    let (k, relaxation) = (grab.stiffness.unwrap(), grab.relaxation);
    let mut writer = ModelWriter::new();
    let mut local = LocalModel::default();
    let stiffness = [[k, 0.0, 0.0], [0.0, k, 0.0], [0.0, 0.0, k]];
    let felt = |x: f64| PublishedGrab { key: 5, point: [x, 0.0, 0.0], stiffness, ..PublishedGrab::default() };
    writer.write_forces(&[felt(0.0)], relaxation, 0.0, 0.01, 0.0, &mut local);
    assert!(
        (local.contacts()[0].damping - coupling.damping).abs() < 1e-12,
        "the damper is the same on both sides"
    );
    assert_eq!(local.contacts()[0].velocity, [0.0; 3], "a new grab has not moved");
    writer.write_forces(&[felt(0.001)], relaxation, 0.0, 0.01, 0.01, &mut local);
    assert!((local.contacts()[0].velocity[0] - 0.1).abs() < 1e-12 && local.tick == 2);
    assert!((local.contacts()[0].stiffness[1][1] - k).abs() < 1e-12);
    // The body stores 3 mJ. This hand put in 1 mJ of it (1 N over 1 mm into the body), so others
    // have put in 2 mJ.
    let pushed = PublishedGrab { force: [-1.0, 0.0, 0.0], ..felt(0.002) };
    writer.write_forces(&[pushed], relaxation, 3e-3, 0.01, 0.02, &mut local);
    assert!(
        (local.stored - 3e-3).abs() < 1e-15 && (local.supplied - 2e-3).abs() < 1e-15,
        "{}",
        local.supplied
    );
    assert!(local.partial);
    // The body swings through and back, and nobody puts in energy.
    for stored in [0.0, 3e-3, 1e-3, 3e-3] {
        writer.write_forces(&[pushed], relaxation, stored, 0.01, 0.02, &mut local);
    }
    assert!((local.supplied - 2e-3).abs() < 1e-15, "{}", local.supplied);
    writer.write_forces(&[pushed], relaxation, f64::NAN, 0.01, 0.02, &mut local);
    assert!(local.is_finite() && (local.supplied - 2e-3).abs() < 1e-15);
    writer.write_forces(&[], relaxation, 0.0, 0.01, 0.02, &mut local);
    assert_eq!(local.contacts().len(), 0);
}

#[test]
fn two_devices_at_once() {
    use pliant_haptics::HapticLoop;
    let start = |x: f64| {
        let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
        device.handle().set_target([x, 0.0, 0.0]);
        HapticLoop::start(device, machine::patient()).unwrap()
    };
    let mut hands = [start(0.01), start(-0.01)];
    let mut tick = 0;
    machine::until("each feels its own", || {
        tick += 1;
        let felt = hands.each_mut().map(|hand| {
            hand.publish(|model| {
                model.tick = tick;
                model.period = 0.01;
                model.count = 1;
                model.contacts[0] = spring([0.0; 3], [0.0; 3], 200.0);
            });
            hand.report().tick.wrench.force[0]
        });
        std::thread::sleep(std::time::Duration::from_millis(10));
        if felt[0] < -0.5 && felt[1] > 0.5 { Ok(()) } else { Err(felt) }
    });
}
