//! Stability limits of control theory, reproduced by experiment with the real loop core in virtual
//! time.

use crate::rig;

use pliant_haptics::{HandModel, VirtualConfig};
use rig::Rig;

/// Returns whether the motion of a free device on a bare spring of `k` (and damper `b`) decays. The
/// function compares the energy in the last tenth of the time to that in the second tenth.
fn calms(device: &VirtualConfig, k: f64, b: f64, seconds: f64) -> bool {
    let mut rig = Rig::bare(device.clone(), HandModel::NONE);
    rig.cycle.device_mut().place([1e-3, 0.0, 0.0], [0.0; 3]);
    let ticks = (seconds * 1000.0) as usize;
    let (mut early, mut late) = (0.0f64, 0.0f64);
    for t in 0..ticks {
        rig.spring(k, b);
        let x = rig.device().position()[0];
        let energy = rig.device().kinetic_energy() + 0.5 * k * x * x;
        if t * 10 / ticks == 1 {
            early = early.max(energy);
        }
        if t * 10 / ticks == 9 {
            late = late.max(energy);
        }
    }
    late < early
}

fn limit(device: &VirtualConfig, b: f64, seconds: f64, low: f64, high: f64) -> f64 {
    let (mut low, mut high) = (low, high);
    assert!(calms(device, low, b, seconds), "{low} N/m should be stable");
    assert!(!calms(device, high, b, seconds), "{high} N/m should not be stable");
    while high / low > 1.002 {
        let middle = 0.5 * (low + high);
        if calms(device, middle, b, seconds) {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

#[test]
fn sampled_spring_is_stable_to_two_b_over_t() {
    for (mass, damping) in [(0.2, 0.5), (0.1, 0.2)] {
        let device = VirtualConfig { mass, damping, peak_force: 1e6, ..VirtualConfig::default() };
        let want = 2.0 * damping / 1e-3;
        let got = limit(&device, 0.0, 3.0, 0.5 * want, 2.0 * want);
        println!("m {mass} kg, b {damping} N s/m: stable to {got:.1} N/m, 2 b / T = {want:.1}");
        assert!((got / want - 1.0).abs() < 0.02, "{got} for {want}");
    }
}

#[test]
fn delayed_spring_is_stable_to_the_known_limit() {
    for (damping, b, delay) in [(0.5, 0.5, 4usize), (0.5, 0.0, 2), (0.3, 1.0, 8)] {
        let device = VirtualConfig {
            mass: 0.2,
            damping,
            delay_periods: delay,
            peak_force: 1e6,
            ..VirtualConfig::default()
        };
        let want = (damping + b) / (0.5e-3 + delay as f64 * 1e-3);
        let got = limit(&device, b, 4.0, 0.5 * want, 2.0 * want);
        println!(
            "b {damping}, B {b} N s/m, d {delay} ms: stable to {got:.1} N/m, (b + B) / (T/2 + d) = {want:.1}"
        );
        assert!((got / want - 1.0).abs() < 0.10, "{got} for {want}");
    }
}

/// Returns the largest speed in the last half second, m/s, for a device that meets a wall at 0.2
/// m/s. The wall is three times as stiff as the device renders stably.
fn speed_at_wall(controlled: bool, resolution: f64, push: f64) -> f64 {
    let device =
        VirtualConfig { mass: 0.2, damping: 0.5, resolution, peak_force: 30.0, ..VirtualConfig::default() };
    let mut rig = Rig::with(device, HandModel::NONE, |s| {
        s.ramp = Some(1e-6);
        s.velocity = None;
        s.thermal = None;
        if !controlled {
            s.passivity = None;
            s.max_damping = None;
        }
    });
    // A weight of `push` newtons into the wall acts like a hand that leans on it.
    let map = pliant_haptics::ToolMap { mass: push / 9.806_65, ..pliant_haptics::ToolMap::default() };
    assert!(rig.cycle.set_tool(map));
    rig.cycle.device_mut().place([0.0, 1e-3, 0.0], [0.0, -0.2, 0.0]);
    let mut worst = 0.0f64;
    for t in 0..4000 {
        // The wall is one-sided, so outside there is no force. The measured position decides, as it
        // would in a game.
        let inside = rig.cycle.core().last().position[1] < 0.0;
        rig.spring(if inside { 3000.0 } else { 0.0 }, 0.0);
        if t >= 3500 {
            worst = worst.max(rig.device().velocity()[1].abs());
        }
    }
    worst
}

#[test]
fn passivity_control_calms_a_wall_at_three_times_the_limit() {
    for push in [0.5, 1.0, 3.0] {
        let without = speed_at_wall(false, 50e-6, push);
        let with = speed_at_wall(true, 50e-6, push);
        println!(
            "leaning with {push} N: {:.1} mm/s without, {:.2} mm/s with control",
            without * 1e3,
            with * 1e3
        );
        assert!(without > 0.05, "without control it must oscillate: {without}");
        assert!(with < 5e-3, "with control: {with} m/s");
    }
}

#[test]
fn damped_spring_two_sided_too() {
    // The spring is two-sided at three times the limit, with a 50 um encoder.
    let device = VirtualConfig { resolution: 50e-6, peak_force: 30.0, ..VirtualConfig::default() };
    let run = |controlled: bool| {
        let mut rig = Rig::with(device.clone(), HandModel::NONE, |s| {
            s.ramp = Some(1e-6);
            s.velocity = None;
            s.thermal = None;
            if !controlled {
                s.passivity = None;
            }
        });
        rig.cycle.device_mut().place([0.0; 3], [0.1, 0.0, 0.0]);
        let mut worst = 0.0f64;
        for t in 0..4000 {
            rig.spring(3000.0, 0.0);
            if t >= 3500 {
                worst = worst.max(rig.device().velocity()[0].abs());
            }
        }
        worst
    };
    let (without, with) = (run(false), run(true));
    println!("two-sided: {:.1} mm/s without, {:.2} mm/s with control", without * 1e3, with * 1e3);
    assert!(without > 0.05 && with < 5e-3, "{without} and {with}");
}
