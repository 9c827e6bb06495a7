//! Users, the network and its emulator.

use bevy_egui::egui::{Color32, ComboBox, DragValue, Grid, Ui};

use crate::{
    knob::knob,
    trace::{Trace, color, dot, plot, short},
};

/// The session as the panel shows it.
#[derive(Debug, Clone, Default)]
pub struct NetworkView {
    /// Role of this app in the session in a word or two, for example "host" or "guest, joining".
    pub role: String,
    /// The invite that other users paste to join. A host and a peer have one, a guest has none.
    pub invite: Option<String>,
    /// Round trip, ms.
    pub round_trip_ms: f64,
    /// Smoothed deviation of the round trip, ms.
    pub jitter_ms: f64,
    /// Share of datagrams lost on the incoming and on the outgoing path, %.
    pub loss: [f64; 2],
    /// Received and sent data rate, kbit/s.
    pub rate: [f64; 2],
    /// Number of ticks shown before their data arrived, and number of ticks corrected since. `None`
    /// on a host, which does not wait for data.
    pub repaired: Option<[u64; 2]>,
    /// Number of requests for repeated ticks, sent by a guest or received by a host.
    pub nacks: u64,
    /// Number of complete states applied from snapshots.
    pub snapshots: u64,
    /// Number of datagrams that this end dropped because a queue was full or the path too narrow.
    pub dropped: u64,
    /// Whether packets wait in a queue on the path. The round trip has then grown, and less should
    /// be sent.
    pub queueing: bool,
    /// Distance of the visual state from the best estimate of the true state, %. `None` except on a
    /// guest.
    pub visual_offset: Option<f64>,
    /// Round trip over the last seconds, ms.
    pub round_trips: Trace,
    /// Received data rate over the last seconds, kbit/s.
    pub rates: Trace,
    /// All users of the session.
    pub users: Vec<UserView>,
    /// The emulated link of the session. `None` if it cannot be emulated.
    pub emulator: Option<EmulatorView>,
    /// Set when "Copy" was pressed beside the invite.
    pub copy: bool,
    /// Label of the button that leaves or ends the session: "Leave" or "End the session". `None` if
    /// there is nothing to leave.
    pub way_out: Option<&'static str>,
    /// Set when that button was pressed.
    pub leave: bool,
}

/// A user of the session.
#[derive(Debug, Clone, Default)]
pub struct UserView {
    /// Name of the user, which is untrusted input.
    pub name: String,
    /// Color of the user, sRGB.
    pub color: [u8; 3],
    /// Whether this is the local user.
    pub yourself: bool,
    /// Number of the user's hands on bodies.
    pub hands: usize,
    /// Round trip, ms. `None` if it is not known here.
    pub round_trip_ms: Option<f64>,
    /// Share of datagrams lost on the path from the user and to the user, %. `None` if it is not
    /// known here.
    pub loss: Option<[f64; 2]>,
}

/// The knobs of the link emulator, equal for both directions.
///
/// Moving a knob away from a preset makes the network another network ([`other`](Self::other)),
/// which has knobs for the finer properties too.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EmulatorView {
    /// Names of the presets. The first means no emulation, the last means another network.
    pub presets: Vec<String>,
    /// Index of the preset in use. A knob.
    pub preset: usize,
    /// Whether a recorded path replaces delay, jitter and loss. Their knobs are then disabled.
    pub recorded: bool,
    /// Loss, %. A knob.
    pub loss: f64,
    /// Round trip, ms. A knob.
    pub round_trip_ms: f64,
    /// Mean of the random delay added to the one-way delay of a packet, ms. A knob.
    pub jitter_ms: f64,
    /// Mean length of a burst of losses, ms. 0 loses each packet independently. A knob, disabled
    /// without loss.
    pub burst_ms: f64,
    /// Bandwidth, Mbit/s. 0 means unlimited. A knob.
    pub rate_mbit: f64,
    /// Size of the queue, KiB. Packets that do not fit are dropped. A knob.
    pub queue_kib: f64,
    /// Share of packets that are held back and therefore overtaken, %. A knob.
    pub reordered: f64,
    /// Time for which these packets are held back, and maximum delay of a copy, ms. A knob.
    pub held_back_ms: f64,
    /// Share of packets that arrive twice, %. A knob.
    pub duplicated: f64,
    /// Whether jitter keeps the order of the packets. A knob.
    pub keep_order: bool,
    /// Seed of all random numbers. A knob.
    pub seed: u64,
}

impl EmulatorView {
    /// Whether the network in use is not one of the presets.
    pub fn other(&self) -> bool {
        self.preset > 0 && self.preset + 1 == self.presets.len()
    }
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
            if ui.button("Copy").on_hover_text("Copies the invite. Other users paste it to join.").clicked() {
                network.copy = true;
            }
            // The token in the invite is secret, so it is not shown on the screen.
            let shown = invite.split(['#', '?']).next().unwrap_or_default();
            ui.label(shown);
        });
    }
    for user in &network.users {
        ui.horizontal(|ui| {
            let [r, g, b] = user.color;
            dot(ui, Color32::from_rgb(r, g, b));
            let who = if user.yourself { format!("{} (you)", user.name) } else { user.name.clone() };
            ui.label(who);
            if user.hands > 0 {
                ui.weak(format!("holds {}", user.hands));
            }
            if let Some(ms) = user.round_trip_ms {
                ui.weak(format!("{} ms", short(ms)));
            }
            if let Some([here, there]) = user.loss {
                ui.weak(format!("lost {} % in, {} % out", short(here), short(there)))
                    .on_hover_text("Lost on the way here, and on the way there.");
            }
        });
    }
    Grid::new("pliant network").num_columns(2).spacing([10.0, 2.0]).show(ui, |ui| {
        let mut line = |name: &str, words: String, hover: &str| {
            ui.label(name);
            ui.label(words).on_hover_text(hover);
            ui.end_row();
        };
        let [round_trip, jitter] = [network.round_trip_ms, network.jitter_ms].map(short);
        let waits = if network.queueing { ", queueing" } else { "" };
        line(
            "round trip",
            format!("{round_trip} \u{b1} {jitter} ms{waits}"),
            "Smoothed round trip and its deviation. Queueing: packets wait in a queue on the path, and less should be sent.",
        );
        let [here, there] = network.loss.map(short);
        line("lost", format!("{here} % in, {there} % out"), "Datagrams that did not arrive.");
        let [received, sent] = network.rate.map(short);
        line("rate", format!("{received} kbit/s in, {sent} out"), "UDP payload, including the data of QUIC itself.");
        if let Some([guessed, right]) = network.repaired {
            line(
                "guessed",
                format!("{guessed} ticks, {right} corrected"),
                "Ticks that were displayed before their data arrived, and those that were corrected afterwards.",
            );
        }
        line(
            "requested again",
            format!("{} ticks, snapshots: {}", network.nacks, network.snapshots),
            "Lost ticks that were requested again, and complete states that were received.",
        );
        line(
            "dropped",
            network.dropped.to_string(),
            "Datagrams that this end dropped because a queue was full or the path too narrow.",
        );
        if let Some(offset) = network.visual_offset {
            line(
                "visual offset",
                format!("{} %", short(offset)),
                "Distance of the visual state from the best estimate of the true state.",
            );
        }
    });
    plot(ui, "pliant round trip", "ms", [("round trip", &network.round_trips, color(2))]);
    plot(ui, "pliant rate", "kbit/s", [("received", &network.rates, color(3))]);
    if let Some(emulator) = &mut network.emulator {
        emulator_knobs(ui, emulator);
    }
}

fn emulator_knobs(ui: &mut Ui, emulator: &mut EmulatorView) {
    let name = emulator.presets.get(emulator.preset).cloned().unwrap_or_default();
    ComboBox::from_label("emulated network").selected_text(name).show_ui(ui, |ui| {
        for (index, name) in emulator.presets.iter().enumerate() {
            ui.selectable_value(&mut emulator.preset, index, name);
        }
    });
    if emulator.preset == 0 {
        return;
    }
    ui.add_enabled_ui(!emulator.recorded, |ui| {
        knob(ui, &mut emulator.loss, 0.0..=50.0, |slider| slider.text("% lost").max_decimals(1));
        knob(ui, &mut emulator.round_trip_ms, 0.0..=1000.0, |slider| {
            slider.text("ms round trip").max_decimals(1)
        });
        knob(ui, &mut emulator.jitter_ms, 0.0..=100.0, |slider| slider.text("ms jitter").max_decimals(2));
    });
    if !emulator.other() {
        return;
    }
    ui.add_enabled_ui(!emulator.recorded && emulator.loss > 0.0, |ui| {
        knob(ui, &mut emulator.burst_ms, 0.0..=500.0, |slider| slider.text("ms bursts").max_decimals(1))
            .on_hover_text("Mean length of a burst of losses; 0 loses each packet independently.");
    });
    knob(ui, &mut emulator.rate_mbit, 0.0..=1000.0, |slider| {
        slider.logarithmic(true).smallest_positive(0.1).text("Mbit/s").max_decimals(2)
    })
    .on_hover_text("Capacity of the link; 0 means unlimited.");
    knob(ui, &mut emulator.queue_kib, 1.0..=1024.0, |slider| {
        slider.logarithmic(true).text("KiB queue").max_decimals(0)
    })
    .on_hover_text("Size of the queue before the link; packets that do not fit are dropped.");
    knob(ui, &mut emulator.reordered, 0.0..=50.0, |slider| slider.text("% reordered").max_decimals(1))
        .on_hover_text("Share of packets that are held back, so that others overtake them.");
    knob(ui, &mut emulator.held_back_ms, 0.0..=200.0, |slider| slider.text("ms held back").max_decimals(1))
        .on_hover_text("Time for which these packets are held back, and the maximum delay of a copy.");
    knob(ui, &mut emulator.duplicated, 0.0..=50.0, |slider| slider.text("% twice").max_decimals(1))
        .on_hover_text("Share of packets that arrive twice.");
    ui.checkbox(&mut emulator.keep_order, "jitter keeps the order");
    ui.horizontal(|ui| {
        let label = ui.label("seed");
        let mut seed = emulator.seed;
        let field = ui.add(DragValue::new(&mut seed).speed(1.0)).labelled_by(label.id);
        if field.changed() && !field.lost_focus() {
            emulator.seed = seed;
        }
    });
}
