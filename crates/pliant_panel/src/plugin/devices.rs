//! Haptic devices.

use std::collections::HashMap;

use bevy::{ecs::system::SystemParam, prelude::*};
use bevy_egui::egui::Ui;
use pliant_haptics::{DeviceId, HapticDevices, LoopState};

use crate::{
    Trace,
    device::{self, DeviceView, DevicesView},
};

/// What the panel remembers of the devices.
#[derive(Resource, Default)]
pub(super) struct Histories {
    forces: HashMap<DeviceId, Trace>,
    recording: HashMap<DeviceId, bool>,
}

#[derive(SystemParam)]
pub(super) struct Devices<'w> {
    devices: Option<ResMut<'w, HapticDevices>>,
    histories: ResMut<'w, Histories>,
    time: Res<'w, Time<Real>>,
}

impl Devices<'_> {
    pub fn are_there(&self) -> bool {
        self.devices.as_ref().is_some_and(|devices| devices.iter().next().is_some())
    }

    pub fn show(&mut self, ui: &mut Ui) {
        let Some(devices) = &mut self.devices else { return };
        let now = self.time.elapsed_secs_f64();
        let Histories { forces, recording } = &mut *self.histories;
        forces.retain(|id, _| devices.get(*id).is_some());
        recording.retain(|id, _| devices.get(*id).is_some());
        let mut view = DevicesView::default();
        let mut ids = Vec::new();
        for (id, status) in devices.iter() {
            let report = &status.report;
            let force = report.tick.wrench.force.iter().map(|f| f * f).sum::<f64>().sqrt();
            let trace = forces.entry(id).or_default();
            trace.push(now, force);
            let fault = match report.state {
                LoopState::Running => report.tick.fault.map(|fault| fault.to_string()),
                LoopState::Calibrating => Some("waits for its calibration".into()),
                LoopState::Lost => Some("lost; it is looked for".into()),
                LoopState::Stopped => {
                    view.stopped = true;
                    None
                }
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
                fault,
                forces: trace.clone(),
                recording: recording.get(&id).copied().unwrap_or(false),
            });
        }
        device::show(ui, &mut view);
        for (id, device) in ids.into_iter().zip(&view.devices) {
            if device.recording != recording.get(&id).copied().unwrap_or(false)
                && devices.set_recording(id, device.recording)
            {
                recording.insert(id, device.recording);
            }
        }
        if view.stop {
            devices.estop();
        }
        if view.reset {
            devices.reset_stop();
        }
    }
}
