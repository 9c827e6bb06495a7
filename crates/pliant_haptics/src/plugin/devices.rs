//! The devices that are running, and what they say.

use std::sync::atomic::{AtomicBool, Ordering};

use bevy::{platform::cell::SyncCell, prelude::*};

use crate::{
    Coupling, DeviceInfo, Fault, HapticDevice, HapticLoop, LoopConfig, LoopEvent, LoopReport, ModelWriter,
    Record, StartError, StopSwitch, ToolMap,
};

/// Names a device among the [`HapticDevices`]. Never used twice.
#[derive(Reflect, Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct DeviceId(u32);

/// The haptic devices in use. Each runs its loop on a thread of its own until it is removed.
#[derive(Resource, Default)]
pub struct HapticDevices {
    entries: Vec<Entry>,
    next: u32,
    /// The emergency stop, for devices that come later too.
    stopped: AtomicBool,
    /// Buttons of devices that have been taken away while they were down.
    left_down: Vec<HapticButton>,
}

/// What is known of a device, as of this frame.
#[derive(Debug, Clone)]
pub struct DeviceStatus {
    /// What it is.
    pub info: DeviceInfo,
    /// Coupling in force, what was wanted and what clamped it.
    pub coupling: Coupling,
    /// State, wrench, rate, jitter, energy, faults.
    pub report: LoopReport,
}

pub(crate) struct Entry {
    pub(crate) id: DeviceId,
    pub(crate) running: SyncCell<HapticLoop>,
    pub(crate) status: DeviceStatus,
    pub(crate) writer: ModelWriter,
    pub(crate) map: Option<ToolMap>,
    /// The tick of the loop whose tool position the simulation has, s.
    pub(crate) seen: f64,
    /// What the body that the loop steps itself was made for; the default: it has none.
    pub(crate) modal_for: super::local_model::CopyOf,
    pub(crate) elsewhere: super::local_model::Elsewhere,
    /// Buttons that the app has been told are down.
    pressed: u32,
    stop: StopSwitch,
}

/// A button of a device went down or came up.
#[derive(Message, Debug, Clone, Copy, PartialEq)]
pub struct HapticButton {
    /// Whose.
    pub device: DeviceId,
    /// Which, from 0.
    pub button: u32,
    /// Down.
    pub pressed: bool,
}

/// A fault of a device began; the force fades and comes back by itself once it is over.
#[derive(Message, Debug, Clone, Copy, PartialEq)]
pub struct HapticFault {
    /// Whose.
    pub device: DeviceId,
    /// What; `None`: the last one is over.
    pub fault: Option<Fault>,
}

/// A device was lost, came back, or needs a hand.
#[derive(Message, Debug, Clone, Copy, PartialEq)]
pub struct HapticNotice {
    /// Which.
    pub device: DeviceId,
    /// [`LoopEvent::Lost`], [`LoopEvent::Returned`] or [`LoopEvent::Calibrate`].
    pub event: LoopEvent,
}

impl HapticDevices {
    /// Takes a device into use: its loop starts at once. Under a latched [`estop`](Self::estop) it gives no force until the
    /// [`reset_stop`](Self::reset_stop).
    ///
    /// # Errors
    /// As [`HapticLoop::start`].
    pub fn add(
        &mut self,
        device: impl HapticDevice + 'static,
        config: LoopConfig,
    ) -> Result<DeviceId, StartError> {
        let mut running = HapticLoop::start(device, config)?;
        if self.is_stopped() {
            // It has no word of the simulation yet, and so no force either.
            running.emergency_stop();
        }
        let id = DeviceId(self.next);
        self.next += 1;
        let status = DeviceStatus {
            info: running.info().clone(),
            coupling: *running.coupling(),
            report: *running.report(),
        };
        self.entries.push(Entry {
            id,
            stop: running.stop_switch(),
            running: SyncCell::new(running),
            status,
            writer: ModelWriter::new(),
            map: None,
            seen: 0.0,
            modal_for: super::local_model::CopyOf::default(),
            elsewhere: super::local_model::Elsewhere::default(),
            pressed: 0,
        });
        Ok(id)
    }

    /// Stops a device and gives it back to nobody: its buttons come up, and its tools let go of what they hold in the next frame. `false`: there is
    /// none of that name.
    pub fn remove(&mut self, id: DeviceId) -> bool {
        let Some(entry) = self.entries.iter().position(|e| e.id == id) else { return false };
        let down = self.entries.remove(entry).pressed;
        self.left_down.extend((0..32).filter(|bit| down >> bit & 1 == 1).map(|button| HapticButton {
            device: id,
            button,
            pressed: false,
        }));
        true
    }

    /// What is known of a device.
    pub fn get(&self, id: DeviceId) -> Option<&DeviceStatus> {
        self.entries.iter().find(|e| e.id == id).map(|e| &e.status)
    }

    /// All devices, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = (DeviceId, &DeviceStatus)> {
        self.entries.iter().map(|e| (e.id, &e.status))
    }

    /// Emergency stop: no force on any device from its loop's next period on, nor on any that is added later. Latched until
    /// [`reset_stop`](Self::reset_stop).
    pub fn estop(&self) {
        self.stopped.store(true, Ordering::Release);
        for entry in &self.entries {
            entry.stop.press();
        }
    }

    /// Whether the emergency stop is latched.
    pub fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Acquire)
    }

    /// Unlatches the emergency stop of all devices; forces come back by their ramps. It stays latched where a loop was too busy to be told.
    pub fn reset_stop(&mut self) {
        self.stopped.store(false, Ordering::Release);
        for entry in &mut self.entries {
            if !entry.running.get().reset_stop() {
                self.stopped.store(true, Ordering::Release);
                warn!("{}: the emergency stop could not be reset, the loop is busy", entry.status.info.name);
            }
        }
    }

    /// Begins or ends the writing down of a device's periods. `false`: no such device, or its loop is busy.
    pub fn set_recording(&mut self, id: DeviceId, on: bool) -> bool {
        self.entry(id).is_some_and(|e| e.running.get().set_recording(on))
    }

    /// What has been written down since the last call.
    pub fn records(&mut self, id: DeviceId) -> Vec<Record> {
        self.entry(id).map(|e| e.running.get().records().collect()).unwrap_or_default()
    }

    pub(crate) fn entry(&mut self, id: DeviceId) -> Option<&mut Entry> {
        self.entries.iter_mut().find(|e| e.id == id)
    }
}

pub(crate) fn read(
    mut devices: ResMut<HapticDevices>,
    mut buttons: MessageWriter<HapticButton>,
    mut faults: MessageWriter<HapticFault>,
    mut notices: MessageWriter<HapticNotice>,
) {
    buttons.write_batch(devices.left_down.drain(..));
    for entry in &mut devices.entries {
        let device = entry.id;
        entry.status.report = *entry.running.get().report();
        if let Some(coupling) = entry.status.report.coupling {
            entry.status.coupling = coupling;
        }
        for event in entry.running.get().events() {
            match event {
                LoopEvent::Pressed(button) => {
                    entry.pressed |= 1 << button;
                    buttons.write(HapticButton { device, button, pressed: true });
                }
                LoopEvent::Released(button) => {
                    entry.pressed &= !(1 << button);
                    buttons.write(HapticButton { device, button, pressed: false });
                }
                LoopEvent::Fault(fault) => {
                    faults.write(HapticFault { device, fault: Some(fault) });
                }
                LoopEvent::Clear => {
                    faults.write(HapticFault { device, fault: None });
                }
                event => {
                    notices.write(HapticNotice { device, event });
                }
            }
        }
    }
}
