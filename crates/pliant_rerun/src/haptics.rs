//! What the devices do: their force, how late their loops are, what the hand got, and what is wrong.

use std::collections::HashMap;

use bevy::prelude::*;
use pliant_haptics::{DeviceId, HapticDevices, LoopState};

use crate::RerunScalars;

/// What was said last of a device: its state, and its fault in words.
type Said = HashMap<DeviceId, (LoopState, Option<String>)>;

pub(crate) fn see_devices(devices: Res<HapticDevices>, mut own: ResMut<RerunScalars>, mut said: Local<Said>) {
    said.retain(|id, _| devices.get(*id).is_some());
    let mut names: Vec<&str> = Vec::new();
    for (id, status) in devices.iter() {
        let report = &status.report;
        let name = status.info.name.replace('/', " ");
        let nth = names.iter().filter(|other| **other == status.info.name).count();
        names.push(&status.info.name);
        let name = if nth == 0 { name } else { format!("{name} {}", nth + 1) };
        let force = report.tick.wrench.force.iter().map(|f| f * f).sum::<f64>().sqrt();
        own.set(format!("device/{name}/force"), "N", force);
        own.set(format!("device/{name}/late, 99 %"), "us", report.lateness.percentile(0.99) * 1e6);
        own.set(
            format!("device/{name}/given to the hand"),
            "J",
            report.tick.port.given - report.tick.port.taken,
        );
        let fault = report.tick.fault.map(|fault| fault.to_string());
        let now = (report.state, fault);
        if said.get(&id) == Some(&now) {
            continue;
        }
        match &now {
            (LoopState::Running, None) => own.say(format!("{name}: running")),
            (LoopState::Running, Some(fault)) => own.warn(format!("{name}: {fault}")),
            (state, None) => own.warn(format!("{name}: {}", words(*state))),
            (state, Some(fault)) => own.warn(format!("{name}: {}, {fault}", words(*state))),
        }
        said.insert(id, now);
    }
}

fn words(state: LoopState) -> &'static str {
    match state {
        LoopState::Running => "running",
        LoopState::Calibrating => "waits for its calibration",
        LoopState::Lost => "lost, and looked for",
        LoopState::Stopped => "stopped",
        LoopState::Ended => "its loop has ended",
        _ => "in a state that this recorder does not know",
    }
}
