//! The bodies of a scene: modes, damping, energy, rest, and the hands on them.

use bevy_egui::egui::{CollapsingHeader, Color32, Ui};
use pliant_body::StepSettings;

use crate::{
    knob::knob,
    trace::{Trace, color, dot, plot, short},
};

/// A body as the panel shows it. What a knob changes is changed here; the caller takes it over.
#[derive(Debug, Clone, Default)]
pub struct BodyView {
    /// What it is called.
    pub name: String,
    /// Modes that are kept. A knob.
    pub modes: usize,
    /// Modes that its model has.
    pub all_modes: usize,
    /// Frequency of the slowest mode, Hz.
    pub lowest_hz: f64,
    /// How it is stepped. Stiffness, damping and warp have knobs.
    pub settings: StepSettings,
    /// Stepped by this app; else somebody else moves it, and its knobs are theirs.
    pub local: bool,
    /// At rest: not stepped, sent or drawn anew.
    pub resting: bool,
    /// Kinetic and elastic energy, J.
    pub energy: f64,
    /// Energy over the last seconds, J.
    pub energies: Trace,
    /// The hands on it.
    pub hands: Vec<HandView>,
    /// Its header is closed: what stands under it need not be filled in. Set by [`show`], for the next frame; a body that comes folded is first shown
    /// so.
    pub folded: bool,
    /// Somebody pressed "Wake".
    pub wake: bool,
    /// Somebody pressed "Let go".
    pub release: bool,
}

/// A hand on a body.
#[derive(Debug, Clone, Default)]
pub struct HandView {
    /// Whose it is.
    pub name: String,
    /// The color of whose it is, sRGB; `None` takes one of the plot's own.
    pub color: Option<[u8; 3]>,
    /// It is held from here, and "Let go" takes it off.
    pub releasable: bool,
    /// Magnitude of the reaction, N.
    pub force: f64,
    /// The same over the last seconds.
    pub forces: Trace,
}

/// Shows `bodies`, each under a header of its own.
pub fn show(ui: &mut Ui, bodies: &mut [BodyView]) {
    if bodies.is_empty() {
        ui.weak("No bodies.");
    }
    let many = bodies.len() > 3;
    for (index, body) in bodies.iter_mut().enumerate() {
        let state = match (body.local, body.resting) {
            (false, _) => "remote",
            (true, true) => "rests",
            (true, false) => "moves",
        };
        let folded = body.folded;
        let header = CollapsingHeader::new(format!("{} \u{b7} {state}", body.name))
            .id_salt(("pliant body", index))
            .default_open(!many && !folded)
            .show(ui, |ui| {
                // Just opened: there is nothing to show yet, and nothing that a knob could change.
                if !folded {
                    body_knobs(ui, index, body);
                }
            });
        body.folded = header.body_returned.is_none() && header.openness == 0.0;
    }
}

fn body_knobs(ui: &mut Ui, index: usize, body: &mut BodyView) {
    ui.add_enabled_ui(body.local, |ui| {
        knob(ui, &mut body.modes, 1..=body.all_modes.max(1), |slider| slider.text("modes"))
            .on_hover_text("How many modes are simulated, the slowest first.");
        knob(ui, &mut body.settings.stiffness_scale, 0.1..=10.0, |slider| {
            slider.logarithmic(true).text("stiffness").max_decimals(2)
        })
        .on_hover_text("Multiplies Young's modulus: four times as stiff swings twice as fast.");
        knob(ui, &mut body.settings.damping_scale, 0.0..=10.0, |slider| {
            slider.text("damping").max_decimals(2)
        })
        .on_hover_text("Multiplies the damping that was baked.");
        ui.checkbox(&mut body.settings.warp, "modal warping")
            .on_hover_text("Right for large rotations; off is the plain linear shape.");
    });
    ui.horizontal(|ui| {
        ui.label(format!("{} Hz \u{b7} {} J", short(body.lowest_hz), short(body.energy)));
        if body.resting && ui.button("Wake").clicked() {
            body.wake = true;
        }
        let releasable = body.hands.iter().filter(|hand| hand.releasable).count();
        let words = if releasable == body.hands.len() {
            "Takes every hand off this body."
        } else {
            "Takes off the hands that are held from here; the others let go themselves."
        };
        if releasable > 0 && ui.button("Let go").on_hover_text(words).clicked() {
            body.release = true;
        }
    });
    plot(ui, &format!("pliant energy {index}"), "J", [("energy", &body.energies, color(0))]);
    let color_of = |index: usize, hand: &HandView| {
        hand.color.map_or_else(|| color(index), |[r, g, b]| Color32::from_rgb(r, g, b))
    };
    for (hand_index, hand) in body.hands.iter().enumerate() {
        ui.horizontal(|ui| {
            dot(ui, color_of(hand_index, hand));
            ui.label(format!("{}: {} N", hand.name, short(hand.force)));
        });
    }
    let hands = body.hands.iter().enumerate();
    plot(
        ui,
        &format!("pliant forces {index}"),
        "N",
        hands.map(|(i, hand)| (hand.name.as_str(), &hand.forces, color_of(i, hand))),
    );
}
