//! Hitches: the simulation, or the whole process, stands still for 0.05 to 1 s, again and again,
//! while the hand goes on. What is felt fades, and never rises faster than the device's slew limit.

use crate::rig;

use nalgebra::Vector3;
use pliant_haptics::{HandModel, SafetyConfig, Scheduler, VirtualConfig};
use rig::scene::{Scene, SceneConfig};

/// Length of a session, s.
const SESSION: f64 = 20.0;
/// Time after the last update from which a force that cannot be known is zero, s. It is the default
/// limit, and an update may be as old as a step of the simulation when it comes.
const FADED: f64 = 0.05;

/// Returns a number from 0 to 1 (SplitMix64).
fn random(seed: &mut u64) -> f64 {
    *seed = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *seed;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

/// What a session showed.
#[derive(Debug, Default)]
struct Displayed {
    hitches: u32,
    /// Largest force, N.
    force: f64,
    /// Largest rise of the force in a period as a share of the slew limit.
    rise: f64,
    /// Largest change of the force over the time that it took, also of its direction, as a share
    /// of the same. A force that cannot be known any more after a stall of the process ends there.
    change: f64,
    /// Largest force more than [`FADED`] after the last update, N.
    late: f64,
}

/// Runs a session in which the hand drags the body about. The simulation hitches if it `hitches`.
fn session(device: VirtualConfig, modal: bool, hitches: bool, mut seed: u64) -> Displayed {
    let config = SceneConfig { modes: 12, hand: HandModel::FIRM, device, modal, ..SceneConfig::default() };
    let mut scene = Scene::new(config);
    let limit = SafetyConfig::for_device(scene.cycle.core().info(), 1000.0).slew.unwrap() * 1e-3;
    let mut displayed = Displayed::default();
    // Time to the next change between a simulation that runs and one that stands still, s.
    let mut left = 0.8;
    let mut last = Vector3::zeros();
    let phases = [0.0; 3].map(|_| 6.3 * random(&mut seed));
    for k in 0..(SESSION * 1e3) as u32 {
        let t = f64::from(k) * 1e-3;
        // Up to 6 mm and 3 cm/s along each axis. The force then stays below the device's peak,
        // which would conceal a kick.
        let at = |axis: usize, hz: f64| 0.006 * (6.3 * hz * t + phases[axis]).sin() * (t / 0.5).min(1.0);
        scene.hand.set_target([at(0, 0.7), at(1, 0.9), at(2, 0.5)]);
        left -= 1e-3;
        if hitches && left <= 0.0 {
            scene.silent = !scene.silent;
            displayed.hitches += u32::from(scene.silent);
            let share = random(&mut seed);
            left = if scene.silent { 0.05 + 0.95 * share * share } else { 0.05 + 0.75 * share };
            if scene.silent && random(&mut seed) < 0.25 {
                scene.scheduler.stall(left);
                left = 0.0;
            }
        }
        scene.tick();
        let force = Vector3::from(scene.cycle.core().last().wrench.force);
        let periods = (scene.scheduler.last().dt * 1e3).max(1.0);
        displayed.rise = displayed.rise.max((force.norm() - last.norm()) / limit);
        displayed.change = displayed.change.max((force - last).norm() / (periods * limit));
        displayed.force = displayed.force.max(force.norm());
        last = force;
        let silent = scene.cycle.core().last().silent;
        if silent > FADED {
            displayed.late = displayed.late.max(force.norm());
        }
    }
    displayed
}

#[test]
fn a_simulation_that_hitches_fades_and_never_kicks() {
    // The weakest device, whose slew limit is the lowest, and the strongest.
    for (name, device) in [("touch", VirtualConfig::touch()), ("omega", VirtualConfig::omega3())] {
        for modal in [false, true] {
            for seed in 1..=8 {
                let what = format!("{name}, modal: {modal}, seed {seed}");
                let truth = session(device.clone(), modal, false, seed);
                let displayed = session(device.clone(), modal, true, seed);
                println!("{what}: {displayed:.3?}, and {:.3} N without hitches", truth.force);
                assert!(displayed.hitches > 10 && displayed.force > 0.5, "{what}: {displayed:?}");
                assert!(
                    displayed.rise <= 1.000_001 && displayed.change <= 1.000_001,
                    "{what}: {displayed:?}"
                );
                assert_eq!(displayed.late, 0.0, "{what}: {displayed:?}");
                assert!(displayed.force <= 1.2 * truth.force, "{what}: {displayed:?} of {} N", truth.force);
            }
        }
    }
}
