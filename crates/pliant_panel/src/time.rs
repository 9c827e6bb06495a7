//! Time: pause, single steps, speed.

use bevy_egui::egui::Ui;

use crate::{
    knob::knob,
    trace::{Trace, color, plot, short},
};

/// The clock as the panel shows it.
#[derive(Debug, Clone, Default)]
pub struct TimeView {
    /// Whether time is paused. A knob.
    pub paused: bool,
    /// Simulated seconds per second. A knob.
    pub speed: f64,
    /// Length of a step, s.
    pub step: f64,
    /// Number of the newest step.
    pub tick: u64,
    /// Set when a single step was requested.
    pub step_once: bool,
    /// Time of the steps of all bodies in a tick, ms, over the last seconds.
    pub step_ms: Trace,
    /// Time of updating the surfaces in a frame, ms.
    pub deform_ms: Trace,
}

/// Shows the clock.
pub fn show(ui: &mut Ui, time: &mut TimeView) {
    ui.horizontal(|ui| {
        let word = if time.paused { "Run" } else { "Pause" };
        if ui.button(word).clicked() {
            time.paused = !time.paused;
        }
        if ui.button("Step").on_hover_text("Stops, and goes on by one step.").clicked() {
            time.paused = true;
            time.step_once = true;
        }
        ui.label(format!("tick {} \u{b7} {} ms", time.tick, short(time.step * 1e3)));
    });
    knob(ui, &mut time.speed, 0.05..=4.0, |slider| slider.logarithmic(true).text("speed").max_decimals(2))
        .on_hover_text("Simulated seconds a second.");
    plot(
        ui,
        "pliant cost",
        "ms",
        [("step", &time.step_ms, color(0)), ("surfaces", &time.deform_ms, color(1))],
    );
}
