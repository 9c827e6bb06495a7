//! A position without motors: pointer, gamepad or script. The force is only drawn.

use std::sync::{
    Arc, Mutex, PoisonError,
    atomic::{AtomicU64, Ordering},
};

use nalgebra::Vector3;

use crate::{DeviceInfo, Fault, HapticDevice, Sample, Scheduler, Wrench};

/// Natural frequency of the motion to the target, rad/s. The motion is critically damped and within
/// 1 % after 80 ms.
const CATCH_UP: f64 = 80.0;
/// Maximum speed, m/s. A pointer that leaps then looks like a fast hand and not like a failed
/// measurement.
const FASTEST: f64 = 4.0;

/// A device that moves smoothly to the target of its handle, as a hand would.
#[derive(Debug)]
pub struct Positioned {
    name: String,
    handle: PositionedHandle,
    wanted: Sample,
    position: Vector3<f64>,
    velocity: Vector3<f64>,
    sequence: u64,
}

/// Moves a [`Positioned`] device from another thread.
#[derive(Debug, Clone, Default)]
pub struct PositionedHandle(Arc<PositionedShared>);

#[derive(Debug, Default)]
struct PositionedShared {
    wanted: Mutex<Sample>,
    /// Force and torque, each number in its own atomic. The wrench is only drawn, and the loop must
    /// not wait for the reader.
    wrench: [AtomicU64; 6],
}

impl PositionedHandle {
    /// Sets the target position (m, device axes) and the buttons that are down. A position that is
    /// not finite is refused, but the buttons still count.
    pub fn set(&self, position: [f64; 3], buttons: u32) {
        let mut wanted = self.0.wanted.lock().unwrap_or_else(PoisonError::into_inner);
        wanted.buttons = buttons;
        if position.iter().all(|x| x.is_finite()) {
            wanted.position = position;
        }
    }

    /// Presses exactly these buttons, wherever the device is.
    pub fn set_buttons(&self, buttons: u32) {
        self.0.wanted.lock().unwrap_or_else(PoisonError::into_inner).buttons = buttons;
    }

    /// Returns the wrench on the hand, to be drawn.
    pub fn wrench(&self) -> Wrench {
        let n = |i: usize| f64::from_bits(self.0.wrench[i].load(Ordering::Relaxed));
        Wrench { force: [n(0), n(1), n(2)], torque: [n(3), n(4), n(5)] }
    }

    fn show(&self, wrench: &Wrench) {
        for (cell, x) in self.0.wrench.iter().zip(wrench.force.iter().chain(&wrench.torque)) {
            cell.store(x.to_bits(), Ordering::Relaxed);
        }
    }
}

impl Positioned {
    /// Creates a device of this name in the center of its workspace.
    pub fn new(name: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            handle: PositionedHandle::default(),
            wanted: Sample::default(),
            position: Vector3::zeros(),
            velocity: Vector3::zeros(),
            sequence: 0,
        }
    }

    /// Returns the handle that moves the device while the loop owns it.
    pub fn handle(&self) -> PositionedHandle {
        self.handle.clone()
    }

    /// Moves the position over `dt` seconds by a critically damped spring to the target, in closed
    /// form.
    fn go(&mut self, dt: f64) {
        let off = self.position - Vector3::from(self.wanted.position);
        let lean = self.velocity + off * CATCH_UP;
        let fade = (-CATCH_UP * dt).exp();
        let step = (off + lean * dt) * fade - off;
        let velocity = (self.velocity - lean * (CATCH_UP * dt)) * fade;
        let longest = FASTEST * dt;
        let capped = crate::clamp_magnitude(&step, longest);
        self.velocity = if capped == step { crate::clamp_magnitude(&velocity, FASTEST) } else { capped / dt };
        self.position += capped;
    }
}

impl HapticDevice for Positioned {
    fn info(&self) -> DeviceInfo {
        DeviceInfo {
            name: self.name.clone(),
            serial: String::new(),
            // The device exerts no real force. The limits only serve to scale an arrow on the
            // screen.
            peak_force: 20.0,
            continuous_force: 20.0,
            peak_torque: 0.0,
            force_axes: [true; 3],
            torque_axes: [false; 3],
            max_stiffness: 1000.0,
            max_damping: 10.0,
            damping: 1.0,
            friction: 0.0,
            mass: 0.2,
            resolution: 0.0,
            delay: 0.0,
            workspace: [[-1.0; 3], [1.0; 3]],
            buttons: 32,
            simulated: true,
        }
    }

    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        let period = scheduler.wait();
        // A pointer moves once per frame and exerts no force. If its owner is just writing, the
        // last target will do.
        if let Ok(wanted) = self.handle.0.wanted.try_lock() {
            self.wanted = *wanted;
        }
        self.handle.show(wrench);
        if period.dt > 0.0 {
            self.go(period.dt.min(0.05));
        }
        // There is no measurement that could freeze. The counter marks a pointer at rest as alive.
        self.sequence += 1;
        Ok(Sample {
            position: self.position.into(),
            velocity: Some(self.velocity.into()),
            sequence: Some(self.sequence),
            ..self.wanted
        })
    }

    fn safe_stop(&mut self) {
        self.handle.show(&Wrench::ZERO);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cycle, LocalModel, LoopConfig, LoopEvent, ToolContact, VirtualScheduler};

    #[test]
    fn a_stop_waits_for_nobody() {
        let mut device = Positioned::new("pointer");
        let handle = device.handle();
        let push = Wrench { force: [1.0, 2.0, 3.0], torque: [4.0, 5.0, 6.0] };
        device.exchange(&push, &mut VirtualScheduler::new(1000.0)).unwrap();
        assert_eq!(handle.wrench(), push);
        // Another thread holds the lock of the target for an unlimited time.
        let moving = handle.0.wanted.lock().unwrap();
        let stopped = std::thread::spawn(move || device.safe_stop());
        // A thread that waits for the lock never ends. A thread that a busy machine delays does
        // end.
        let begun = std::time::Instant::now();
        while !stopped.is_finished() {
            assert!(begun.elapsed().as_secs() < 60, "the loop's thread waits for a lock");
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        drop(moving);
        assert_eq!(handle.wrench(), Wrench::ZERO);
    }

    #[test]
    fn buttons_come_up_wherever_the_pointer_is() {
        let mut device = Positioned::new("pointer");
        device.handle().set([0.0; 3], 1);
        device.handle().set([f64::NAN, 0.0, 0.0], 0);
        let sample = device.exchange(&Wrench::ZERO, &mut VirtualScheduler::new(1000.0)).unwrap();
        assert_eq!((sample.buttons, sample.position), (0, [0.0; 3]));
    }

    #[test]
    fn a_leaping_pointer_is_a_hand_that_hurries_and_a_still_one_is_no_dead_device() {
        let device = Positioned::new("pointer");
        let handle = device.handle();
        let mut cycle = Cycle::new(device, LoopConfig::default()).unwrap();
        let mut scheduler = VirtualScheduler::new(1000.0);
        let mut events: Vec<LoopEvent> = Vec::new();
        let k = 100.0;
        let mut model = LocalModel { period: 0.01, count: 1, ..LocalModel::default() };
        model.contacts[0] = ToolContact {
            stiffness: [[k, 0.0, 0.0], [0.0, k, 0.0], [0.0, 0.0, k]],
            ..ToolContact::default()
        };
        let mut fastest = 0.0f64;
        let mut run = |cycle: &mut Cycle<Positioned>, events: &mut Vec<LoopEvent>, ticks: usize| {
            for _ in 0..ticks {
                model.tick += 1;
                cycle.step(&mut scheduler, &model, events);
                fastest = fastest.max(cycle.core().last().velocity[0].abs());
            }
        };
        run(&mut cycle, &mut events, 500);
        // The pointer moves by 15 cm between two frames.
        handle.set([0.15, 0.0, 0.0], 1);
        run(&mut cycle, &mut events, 150);
        assert!((cycle.core().last().position[0] - 0.15).abs() < 1e-4, "{:?}", cycle.core().last().position);
        // The pointer then stays still for three seconds, with a force of 15 N on the screen.
        run(&mut cycle, &mut events, 3000);
        assert!((handle.wrench().force[0] + 15.0).abs() < 0.05, "{:?}", handle.wrench());
        assert!(events.contains(&LoopEvent::Pressed(0)));
        let wrong = |e: &LoopEvent| {
            matches!(
                e,
                LoopEvent::Fault(Fault::Jump(_) | Fault::Frozen(_) | Fault::NotFinite) | LoopEvent::Lost
            )
        };
        assert!(!events.iter().any(wrong), "{events:?}");
        handle.set([f64::NAN, 0.0, 0.0], 0);
        run(&mut cycle, &mut events, 100);
        assert!((cycle.core().last().position[0] - 0.15).abs() < 1e-4, "refused");
        assert!(fastest <= FASTEST + 1e-9 && fastest > 2.0, "{fastest} m/s");
    }
}
