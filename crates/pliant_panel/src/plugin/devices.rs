//! Haptic devices.

use std::collections::HashMap;

use bevy::{ecs::system::SystemParam, prelude::*};
use bevy_egui::egui::Ui;
use pliant_haptics::{DeviceId, HapticDevices, HapticNotice, HapticTool, LoopEvent, LoopState};

use crate::{
    Trace,
    device::{self, DeviceView, DevicesView},
};

/// Data of the devices that the panel keeps between frames.
#[derive(Resource, Default)]
pub(super) struct DeviceHistories {
    forces: HashMap<DeviceId, Trace>,
    /// The calibration step that each device has asked the user for.
    calibrate: HashMap<DeviceId, &'static str>,
}

#[derive(SystemParam)]
pub(super) struct Devices<'w, 's> {
    devices: Option<ResMut<'w, HapticDevices>>,
    histories: ResMut<'w, DeviceHistories>,
    time: Res<'w, Time<Real>>,
    tools: Query<'w, 's, &'static mut HapticTool>,
    notices: Option<MessageReader<'w, 's, HapticNotice>>,
}

impl Devices<'_, '_> {
    /// Whether there is a device, or a latched stop that also applies to the next device.
    pub fn are_there(&self) -> bool {
        self.devices.as_ref().is_some_and(|devices| devices.is_stopped() || devices.iter().next().is_some())
    }

    /// Shows the emergency stop, which stays visible when sections are folded or scrolled away.
    pub fn show_stop(&mut self, ui: &mut Ui) {
        let Some(devices) = &mut self.devices else { return };
        let one_is = devices.iter().any(|(_, status)| status.report.state == LoopState::Stopped);
        let mut view = DevicesView { stopped: devices.is_stopped() || one_is, ..default() };
        device::show_stop(ui, &mut view);
        if view.stop {
            devices.estop();
        }
        if view.reset {
            devices.reset_stop();
        }
    }

    pub fn show(&mut self, ui: &mut Ui) {
        let Some(devices) = &mut self.devices else { return };
        let now = self.time.elapsed_secs_f64();
        let DeviceHistories { forces, calibrate } = &mut *self.histories;
        for notice in self.notices.iter_mut().flat_map(|notices| notices.read()) {
            if let LoopEvent::Calibrate(how) = notice.event {
                calibrate.insert(notice.device, how);
            }
        }
        forces.retain(|id, _| devices.get(*id).is_some());
        calibrate.retain(|id, _| devices.get(*id).is_some());
        let mut view = DevicesView::default();
        let mut ids = Vec::new();
        for (id, status) in devices.iter() {
            let report = &status.report;
            let force = report.tick.wrench.force.iter().map(|f| f * f).sum::<f64>().sqrt();
            let mut trace = forces.remove(&id).unwrap_or_default();
            trace.push(now, force);
            let fault = match report.state {
                LoopState::Running => report.tick.fault.map(|fault| fault.to_string()),
                LoopState::Calibrating => Some("waits for its calibration: no force".into()),
                LoopState::Lost => Some("lost; it is looked for".into()),
                LoopState::Stopped => Some("stopped: no force".into()),
                LoopState::ForceOff => Some("its force is switched off at the device".into()),
                LoopState::Hung => Some("its driver does not answer: its force was cut".into()),
                other => Some(format!("{other:?}")),
            };
            ids.push(id);
            view.devices.push(DeviceView {
                name: status.info.name.clone(),
                force,
                limit: status.info.peak_force,
                rate: report.rate,
                jitter_us: report.lateness.percentile(0.99) * 1e6,
                energy: report.tick.port.given - report.tick.port.taken,
                force_scale: self
                    .tools
                    .iter()
                    .find(|tool| tool.device == id && tool.force_scale.is_finite())
                    .map(|tool| tool.force_scale),
                calibrate: (report.state == LoopState::Calibrating)
                    .then(|| calibrate.get(&id).map_or("see the log", |how| how).to_owned()),
                fault,
                forces: trace,
            });
        }
        device::show_devices(ui, &mut view);
        for (id, device) in ids.iter().zip(&mut view.devices) {
            forces.insert(*id, std::mem::take(&mut device.forces));
        }
        for (id, device) in ids.iter().zip(&view.devices) {
            let Some(scale) = device.force_scale else { continue };
            let one_of_its =
                self.tools.iter_mut().find(|tool| tool.device == *id && tool.force_scale.is_finite());
            if let Some(mut tool) = one_of_its
                && tool.force_scale != scale
            {
                tool.force_scale = scale;
            }
        }
    }
}
