//! A position without motors: pointer, gamepad, script. The force is there to be shown, nobody feels it.

use std::sync::{Arc, Mutex, PoisonError};

use crate::{DeviceInfo, Fault, HapticDevice, Pace, Sample, Wrench};

/// A device that is wherever its handle says.
#[derive(Debug)]
pub struct Positioned {
    name: String,
    handle: PositionedHandle,
    last: Sample,
}

/// Moves a [`Positioned`] device from another thread.
#[derive(Debug, Clone, Default)]
pub struct PositionedHandle(Arc<Mutex<(Sample, Wrench)>>);

impl PositionedHandle {
    /// Puts the device somewhere (m, device axes), with these buttons down. A number that is not finite is refused.
    pub fn set(&self, position: [f64; 3], buttons: u32) {
        if position.iter().all(|x| x.is_finite()) {
            let mut shared = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            shared.0 = Sample { position, buttons, ..shared.0 };
        }
    }

    /// The wrench that a hand would feel: to be shown.
    pub fn wrench(&self) -> Wrench {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).1
    }
}

impl Positioned {
    /// A device of this name in the middle of its workspace.
    pub fn new(name: impl Into<String>) -> Self {
        Self { name: name.into(), handle: PositionedHandle::default(), last: Sample::default() }
    }

    /// To move it with while the loop has it.
    pub fn handle(&self) -> PositionedHandle {
        self.handle.clone()
    }
}

impl HapticDevice for Positioned {
    fn info(&self) -> DeviceInfo {
        DeviceInfo {
            name: self.name.clone(),
            serial: String::new(),
            // Nobody is pushed: these are what an arrow on the screen is scaled by.
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

    fn exchange(&mut self, wrench: &Wrench, pace: &mut dyn Pace) -> Result<Sample, Fault> {
        pace.wait();
        // A pointer moves once a frame and nobody is pushed: were its owner just writing, the last place is as good.
        if let Ok(mut shared) = self.handle.0.try_lock() {
            self.last = shared.0;
            shared.1 = *wrench;
        }
        Ok(self.last)
    }

    fn safe_stop(&mut self) {
        if let Ok(mut shared) = self.handle.0.lock() {
            shared.1 = Wrench::ZERO;
        }
    }
}
