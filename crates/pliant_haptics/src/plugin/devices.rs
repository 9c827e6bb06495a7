//! The running devices and their status.

use std::sync::atomic::{AtomicBool, Ordering};

use bevy::{platform::cell::SyncCell, prelude::*};

use crate::{
    Coupling, DeviceInfo, Fault, HapticDevice, HapticLoop, LoopConfig, LoopEvent, LoopReport, ModelWriter,
    Record, StartError, StopSwitch, ToolMap,
};

/// Identifies a device among the [`HapticDevices`]. An identifier is never used twice.
#[derive(Reflect, Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[reflect(Debug, Default, Clone, PartialEq, Hash)]
pub struct DeviceId(u32);

impl Default for DeviceId {
    /// No device.
    fn default() -> Self {
        Self(u32::MAX)
    }
}

/// The haptic devices in use. Each device runs its loop on its own thread until the app removes the
/// device.
#[derive(Resource, Default)]
pub struct HapticDevices {
    entries: Vec<Entry>,
    next: u32,
    /// Whether the emergency stop is latched. It also applies to devices that are added later.
    stopped: AtomicBool,
    /// Release messages for buttons that were down when their device was removed.
    left_down: Vec<HapticButton>,
}

/// Status of a device in this frame.
#[derive(Debug, Clone)]
pub struct DeviceStatus {
    /// Description of the device.
    pub info: DeviceInfo,
    /// The coupling in force, the wanted coupling and the limits that apply.
    pub coupling: Coupling,
    /// State, wrench, rate, jitter, energy and faults.
    pub report: LoopReport,
}

pub(crate) struct Entry {
    pub(crate) id: DeviceId,
    pub(crate) running: SyncCell<HapticLoop>,
    pub(crate) status: DeviceStatus,
    pub(crate) writer: ModelWriter,
    pub(crate) map: Option<ToolMap>,
    /// Time of the first tick of the loop that was seen after it received the pose of its
    /// workspace, or to where it has jumped, s.
    pub(crate) placed: Option<f64>,
    /// Time of the loop's tick whose tool position the simulation has, s.
    pub(crate) seen: f64,
    /// Inputs of the body copy that the loop steps itself. The default means that there is no copy.
    pub(crate) modal_for: super::local_model::CopyOf,
    pub(crate) elsewhere: super::local_model::Elsewhere,
    /// Buttons that are down according to the messages so far.
    pressed: u32,
    stop: StopSwitch,
}

/// Time after which a loop that received the pose of its workspace reports tools that are there, s.
const PLACED_AFTER: f64 = 0.02;

impl Entry {
    /// Returns whether the tool point that the loop reports is where the tool's entity is.
    pub(crate) fn is_placed(&self) -> bool {
        self.placed.is_some_and(|since| self.seen > since + PLACED_AFTER)
    }
}

/// A button of a device went down or came up.
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct HapticButton {
    /// The device.
    pub device: DeviceId,
    /// The button, from 0.
    pub button: u32,
    /// Whether the button is down.
    pub pressed: bool,
}

/// A fault of a device began or ended. The force fades, and it comes back by itself after the end
/// of the fault.
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(opaque)]
#[reflect(Debug, Clone, PartialEq)]
pub struct HapticFault {
    /// The device.
    pub device: DeviceId,
    /// The fault. `None` means that the last fault is over.
    pub fault: Option<Fault>,
}

/// A device was lost, came back or needs manual calibration.
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(opaque)]
#[reflect(Debug, Clone, PartialEq)]
pub struct HapticNotice {
    /// The device.
    pub device: DeviceId,
    /// The event: [`LoopEvent::Lost`], [`LoopEvent::Returned`] or [`LoopEvent::Calibrate`].
    pub event: LoopEvent,
}

impl HapticDevices {
    /// Adds a device and starts its loop at once. While an [`estop`](Self::estop) is latched, the
    /// device gives no force until [`reset_stop`](Self::reset_stop).
    ///
    /// # Errors
    /// Returns the errors of [`HapticLoop::start`].
    pub fn add(
        &mut self,
        device: impl HapticDevice + 'static,
        config: LoopConfig,
    ) -> Result<DeviceId, StartError> {
        let mut running = HapticLoop::start(device, config)?;
        if self.is_stopped() {
            // The loop has no local model yet, and so it exerts no force before the stop.
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
            placed: None,
            seen: 0.0,
            modal_for: super::local_model::CopyOf::default(),
            elsewhere: super::local_model::Elsewhere::default(),
            pressed: 0,
        });
        Ok(id)
    }

    /// Stops and removes a device. This takes half a second if its driver does not return, see
    /// [`HapticLoop::close`]. Its buttons come up, and its tools release their grabs in the
    /// next frame. Returns `false` if there is no such device.
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

    /// Returns the status of a device.
    pub fn get(&self, id: DeviceId) -> Option<&DeviceStatus> {
        self.entries.iter().find(|e| e.id == id).map(|e| &e.status)
    }

    /// Returns all devices, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = (DeviceId, &DeviceStatus)> {
        self.entries.iter().map(|e| (e.id, &e.status))
    }

    /// Presses the emergency stop of all devices. Each loop exerts no force from its next period
    /// on, or its supervisor cuts the force if the driver does not answer. The stop is latched
    /// until [`reset_stop`](Self::reset_stop), and it also applies to devices that are added later.
    pub fn estop(&self) {
        self.stopped.store(true, Ordering::Release);
        for entry in &self.entries {
            entry.stop.press();
        }
    }

    /// Returns whether the emergency stop is latched.
    pub fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Acquire)
    }

    /// Unlatches the emergency stop of all devices. The forces then rise by their ramps. The stop
    /// stays latched, for all of them, if the queue of a loop was full.
    pub fn reset_stop(&mut self) {
        let mut busy = false;
        for entry in &mut self.entries {
            if !entry.running.get().can_reset_stop() {
                busy = true;
                warn!("{}: the emergency stop could not be reset, the loop is busy", entry.status.info.name);
            }
        }
        if busy {
            return;
        }
        self.stopped.store(false, Ordering::Release);
        for entry in &mut self.entries {
            entry.running.get().reset_stop();
        }
    }

    /// Starts or stops the recording of a device's periods. Returns `false` if there is no such
    /// device or the queue of its loop is full.
    pub fn set_recording(&mut self, id: DeviceId, on: bool) -> bool {
        self.entry(id).is_some_and(|e| e.running.get().set_recording(on))
    }

    /// Returns the records since the last call.
    pub fn records(&mut self, id: DeviceId) -> Vec<Record> {
        self.entry(id).map(|e| e.running.get().records().collect()).unwrap_or_default()
    }

    pub(crate) fn entry(&mut self, id: DeviceId) -> Option<&mut Entry> {
        self.entries.iter_mut().find(|e| e.id == id)
    }
}

impl Drop for HapticDevices {
    /// Asks all loops to end before it waits for the first, so that several drivers that do not
    /// return cost half a second in all.
    fn drop(&mut self) {
        for entry in &mut self.entries {
            entry.running.get().ask_to_end();
        }
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
