//! Haptic devices: force, rate, faults, the emergency stop.

use bevy_egui::egui::{Button, Color32, RichText, Ui, Vec2};

use crate::{
    knob::knob,
    trace::{Trace, color, plot, short},
};

/// The devices as the panel shows them.
#[derive(Debug, Clone, Default)]
pub struct DevicesView {
    /// All connected devices.
    pub devices: Vec<DeviceView>,
    /// Whether the emergency stop is latched.
    pub stopped: bool,
    /// Set when "Stop" was pressed.
    pub stop: bool,
    /// Set when "Release the stop" was pressed.
    pub reset: bool,
}

/// A device.
#[derive(Debug, Clone, Default)]
pub struct DeviceView {
    /// Vendor and model.
    pub name: String,
    /// Force on the hand, N.
    pub force: f64,
    /// Maximum force of the device, N.
    pub limit: f64,
    /// Exchanges per second, Hz.
    pub rate: f64,
    /// 99th percentile of the lateness of an exchange, us.
    pub jitter_us: f64,
    /// Energy that the hand received minus the energy that it gave, J.
    pub energy: f64,
    /// Factor on the force of the tools that this device moves, 0 to 1 on its knob. `None` if the
    /// device moves no tool. A knob.
    pub force_scale: Option<f64>,
    /// Calibration step that the user must perform before the positions are valid.
    pub calibrate: Option<String>,
    /// Fault of the device. `None` without a fault.
    pub fault: Option<String>,
    /// Force over the last seconds, N.
    pub forces: Trace,
}

/// Shows the stop and the devices.
pub fn show(ui: &mut Ui, view: &mut DevicesView) {
    show_stop(ui, view);
    show_devices(ui, view);
}

/// Shows only the emergency stop, for a place where it is always visible.
///
/// The stop can be pressed in every state of the devices. While the stop is latched, its release
/// button is beside it.
pub fn show_stop(ui: &mut Ui, view: &mut DevicesView) {
    ui.horizontal(|ui| {
        let release = view.stopped.then(|| Button::new("Release the stop").min_size(Vec2::new(0.0, 26.0)));
        // The reserved width leaves room for the label of the release button.
        let width = ui.available_width() - if release.is_some() { 130.0 } else { 0.0 };
        let stop = Button::new(RichText::new("STOP").strong().color(Color32::WHITE))
            .fill(Color32::from_rgb(190, 40, 30))
            .min_size(Vec2::new(width.max(40.0), 26.0));
        if ui.add(stop).on_hover_text("Takes the force off every device at once.").clicked() {
            view.stop = true;
        }
        if release.is_some_and(|release| ui.add(release).clicked()) {
            view.reset = true;
        }
    });
    if view.stopped {
        ui.colored_label(Color32::from_rgb(255, 120, 100), "Stopped: no device gives force.");
    }
}

/// Shows the devices without the stop.
pub fn show_devices(ui: &mut Ui, view: &mut DevicesView) {
    if view.devices.is_empty() {
        ui.weak("No device.");
    }
    for (index, device) in view.devices.iter_mut().enumerate() {
        ui.strong(&device.name);
        ui.label(format!(
            "{} of {} N \u{b7} {} Hz \u{b7} late {} \u{b5}s \u{b7} {} J",
            short(device.force),
            short(device.limit),
            short(device.rate),
            short(device.jitter_us),
            short(device.energy)
        ));
        if let Some(how) = &device.calibrate {
            ui.colored_label(Color32::from_rgb(120, 200, 255), format!("Calibrate: {how}"));
        }
        if let Some(fault) = &device.fault {
            ui.colored_label(Color32::from_rgb(255, 170, 80), fault);
        }
        plot(ui, &format!("pliant device {index}"), "N", [("force", &device.forces, color(4))]);
        if let Some(scale) = &mut device.force_scale {
            knob(ui, scale, 0.0..=1.0, |slider| slider.text("force").max_decimals(2))
                .on_hover_text("Share of the body's force that reaches the hand.");
        }
    }
}
