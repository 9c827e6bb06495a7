//! Data of the devices: force, lateness of the loops, energy given to the hand, faults, and every
//! period of the loops.

use std::{
    collections::{HashMap, HashSet},
    sync::Arc,
};

use bevy::prelude::*;
use pliant_haptics::{DeviceId, HapticDevices, LoopState};

use crate::{
    RerunRecording, RerunScalars,
    frame::{Metric, Samples},
};

/// Returns the name of each device. A second device of the same name also gets a number.
fn names(devices: &HapticDevices) -> Vec<(DeviceId, String)> {
    let mut names = Vec::new();
    let mut seen: Vec<&str> = Vec::new();
    for (id, status) in devices.iter() {
        let nth = seen.iter().filter(|other| **other == status.info.name).count();
        seen.push(&status.info.name);
        let name = status.info.name.replace('/', " ");
        names.push((id, if nth == 0 { name } else { format!("{name} {}", nth + 1) }));
    }
    names
}

/// The metrics of each device. They are made once, because they are set in every tick.
type Metrics = Vec<(DeviceId, [Arc<Metric>; 4])>;

pub(crate) fn see_devices(
    devices: Res<HapticDevices>,
    mut own: ResMut<RerunScalars>,
    mut metrics: Local<Metrics>,
) {
    if !devices.iter().map(|(id, _)| id).eq(metrics.iter().map(|(id, _)| *id)) {
        let metric = |name: &str, what: &str, unit: &str| {
            Arc::new(Metric { path: format!("device/{name}/{what}"), unit: unit.to_owned() })
        };
        let of = |name: &str| {
            [
                metric(name, "force", "N"),
                metric(name, "late, 99 %", "us"),
                metric(name, "missed periods", ""),
                metric(name, "given to the hand", "J"),
            ]
        };
        *metrics = names(&devices).iter().map(|(id, name)| (*id, of(name))).collect();
    }
    for ((_, status), (_, [force, late, missed, given])) in devices.iter().zip(&*metrics) {
        let report = &status.report;
        let newton = report.tick.wrench.force.iter().map(|f| f * f).sum::<f64>().sqrt();
        own.measured(force, newton);
        own.measured(late, report.lateness.percentile(0.99) * 1e6);
        own.measured(missed, report.missed as f64);
        own.measured(given, report.tick.port.given - report.tick.port.taken);
    }
}

/// The last logged state and fault of each device.
type Logged = HashMap<DeviceId, (LoopState, Option<String>)>;

pub(crate) fn log_devices(
    devices: Res<HapticDevices>,
    mut own: ResMut<RerunScalars>,
    mut logged: Local<Logged>,
) {
    logged.retain(|id, _| devices.get(*id).is_some());
    for (id, name) in names(&devices) {
        let Some(status) = devices.get(id) else { continue };
        let fault = status.report.tick.fault.map(|fault| fault.to_string());
        let now = (status.report.state, fault);
        if logged.get(&id) == Some(&now) {
            continue;
        }
        match &now {
            (LoopState::Running, None) => own.log(format!("{name}: running")),
            (LoopState::Running, Some(fault)) => own.warn(format!("{name}: {fault}")),
            (state, None) => own.warn(format!("{name}: {}", described(*state))),
            (state, Some(fault)) => own.warn(format!("{name}: {}, {fault}", described(*state))),
        }
        logged.insert(id, now);
    }
}

/// Records every period of the device loops, if [`RerunRecording::device_loops`] is set.
pub(crate) fn take_samples(
    mut devices: ResMut<HapticDevices>,
    recording: Res<RerunRecording>,
    mut own: ResMut<RerunScalars>,
    mut asked: Local<HashSet<DeviceId>>,
) {
    if !recording.device_loops {
        for id in asked.drain() {
            devices.set_recording(id, false);
        }
        return;
    }
    asked.retain(|id| devices.get(*id).is_some());
    for (id, name) in names(&devices) {
        if !asked.contains(&id) {
            if devices.set_recording(id, true) {
                asked.insert(id);
            }
            continue;
        }
        let records = devices.records(id);
        let Some(newest) = records.last().map(|record| record.now) else { continue };
        let mut add = |what: &str, unit, value: &dyn Fn(&pliant_haptics::Record) -> f64| {
            let values = records.iter().map(|record| (newest - record.now, value(record))).collect();
            own.samples.push(Samples { path: format!("device/{name}/loop/{what}"), unit, values });
        };
        for (axis, what) in ["force x", "force y", "force z"].into_iter().enumerate() {
            add(what, "N", &|record| record.wrench.force[axis]);
        }
        for (axis, what) in ["position x", "position y", "position z"].into_iter().enumerate() {
            add(what, "m", &|record| record.sample.position[axis]);
        }
        add("period", "us", &|record| record.dt * 1e6);
    }
}

fn described(state: LoopState) -> &'static str {
    match state {
        LoopState::Running => "running",
        LoopState::Calibrating => "waits for its calibration",
        LoopState::Lost => "lost, and looked for",
        LoopState::Stopped => "stopped",
        LoopState::Ended => "its loop has ended",
        LoopState::ForceOff => "its force is switched off at the device",
        LoopState::Hung => "its driver does not answer",
        _ => "in a state that this recorder does not know",
    }
}
