//! Users, the network and its emulator.

use bevy_egui::egui::{Color32, ComboBox, RichText, Ui};

use crate::{
    knob::knob,
    trace::{Trace, colour, plot, short},
};

/// The session as the panel shows it.
#[derive(Debug, Clone, Default)]
pub struct NetworkView {
    /// What this app is in the session, in a word or two: "host", "guest, joined".
    pub role: String,
    /// What others paste to join; only a host has one.
    pub invite: Option<String>,
    /// Round trip, ms.
    pub round_trip_ms: f64,
    /// Share of datagrams lost on the way here and there, %.
    pub loss: [f64; 2],
    /// Received and sent, kbit/s.
    pub rate: [f64; 2],
    /// Ticks shown on a guess, and put right since.
    pub repaired: [u64; 2],
    /// Round trip over the last seconds, ms.
    pub round_trips: Trace,
    /// Received over the last seconds, kbit/s.
    pub rates: Trace,
    /// Everybody.
    pub users: Vec<UserView>,
    /// The emulated link under the session, where one may be put.
    pub emulator: Option<EmulatorView>,
    /// Somebody pressed "Copy" at the invite.
    pub copy: bool,
    /// What the button says that ends one's part in the session: "Leave", "End the session"; `None` where there is nothing to leave.
    pub way_out: Option<&'static str>,
    /// Somebody pressed it.
    pub leave: bool,
}

/// A user of the session.
#[derive(Debug, Clone, Default)]
pub struct UserView {
    /// What the user is called; from outside.
    pub name: String,
    /// The user's colour, sRGB.
    pub colour: [u8; 3],
    /// Oneself.
    pub yourself: bool,
    /// Hands on bodies.
    pub hands: usize,
    /// Round trip, ms; `None` where it is not known here.
    pub round_trip_ms: Option<f64>,
}

/// The knobs of the link emulator. Moving loss, round trip or jitter away from a preset leaves its other traits (rate, bursts, order) as they are.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EmulatorView {
    /// Names of the presets; the first is no emulation, the last none of the others.
    pub presets: Vec<String>,
    /// The one in use. A knob.
    pub preset: usize,
    /// Loss, %. A knob.
    pub loss: f64,
    /// Round trip, ms. A knob.
    pub round_trip_ms: f64,
    /// Mean of what is added to the way of a packet at random, ms. A knob.
    pub jitter_ms: f64,
}

/// Shows the session.
pub fn show(ui: &mut Ui, network: &mut NetworkView) {
    ui.horizontal(|ui| {
        ui.strong(&network.role);
        if let Some(way_out) = network.way_out
            && ui.button(way_out).clicked()
        {
            network.leave = true;
        }
    });
    if let Some(invite) = &network.invite {
        ui.horizontal(|ui| {
            if ui.button("Copy").on_hover_text("Copies the invite: others paste it to join.").clicked() {
                network.copy = true;
            }
            // The token in it is for those who are invited: it is not for the screen.
            let shown = invite.split(['#', '?']).next().unwrap_or_default();
            ui.label(shown);
        });
    }
    for user in &network.users {
        ui.horizontal(|ui| {
            let [r, g, b] = user.colour;
            ui.label(RichText::new("\u{25cf}").color(Color32::from_rgb(r, g, b)));
            let who = if user.yourself { format!("{} (you)", user.name) } else { user.name.clone() };
            ui.label(who);
            if user.hands > 0 {
                ui.weak(format!("holds {}", user.hands));
            }
            if let Some(ms) = user.round_trip_ms {
                ui.weak(format!("{} ms", short(ms)));
            }
        });
    }
    ui.label(format!(
        "round trip {} ms \u{b7} lost {} % in, {} % out",
        short(network.round_trip_ms),
        short(network.loss[0]),
        short(network.loss[1])
    ));
    ui.label(format!(
        "{} kbit/s in, {} out \u{b7} {} ticks guessed, {} put right",
        short(network.rate[0]),
        short(network.rate[1]),
        network.repaired[0],
        network.repaired[1]
    ));
    plot(ui, "pliant round trip", "ms", [("round trip", &network.round_trips, colour(2))]);
    plot(ui, "pliant rate", "kbit/s", [("received", &network.rates, colour(3))]);
    if let Some(emulator) = &mut network.emulator {
        emulator_knobs(ui, emulator);
    }
}

fn emulator_knobs(ui: &mut Ui, emulator: &mut EmulatorView) {
    let EmulatorView { presets, preset, loss, round_trip_ms, jitter_ms } = emulator;
    let name = presets.get(*preset).cloned().unwrap_or_default();
    ComboBox::from_label("emulated network").selected_text(name).show_ui(ui, |ui| {
        for (index, name) in presets.iter().enumerate() {
            ui.selectable_value(preset, index, name);
        }
    });
    if *preset > 0 {
        knob(ui, loss, 0.0..=50.0, |slider| slider.text("% lost").max_decimals(1));
        knob(ui, round_trip_ms, 0.0..=1000.0, |slider| slider.text("ms round trip").max_decimals(0));
        knob(ui, jitter_ms, 0.0..=100.0, |slider| slider.text("ms jitter").max_decimals(1));
    }
}
