//! The bodies of a scene: modes, damping, energy, rest, and the hands on them.

use bevy_egui::egui::{Checkbox, CollapsingHeader, Color32, Ui};
use pliant_body::{Elasticity, StepSettings};

use crate::{
    knob::knob,
    trace::{Trace, color, dot, plot, short},
};

/// A body as the panel shows it.
///
/// A knob changes its field here. The caller applies the change.
#[derive(Debug, Clone, Default)]
pub struct BodyView {
    /// Name of the body.
    pub name: String,
    /// Number of kept modes. A knob.
    pub modes: usize,
    /// Number of modes of the model.
    pub all_modes: usize,
    /// Name of the material for large strains. Empty if the model has none: its elasticity is then
    /// linear.
    pub material: String,
    /// Frequency of the slowest mode, Hz.
    pub lowest_hz: f64,
    /// Step settings. Stiffness, damping, elasticity and warping have knobs.
    pub settings: StepSettings,
    /// Whether this app steps the body. A remote body has no usable knobs here.
    pub local: bool,
    /// Whether the body rests: it is neither stepped nor sent nor drawn again.
    pub resting: bool,
    /// Mean time of a step of this body, us. `None` if this app does not step it, or if it rests.
    pub step_us: Option<f64>,
    /// Kinetic and elastic energy, J.
    pub energy: f64,
    /// Energy over the last seconds, J.
    pub energies: Trace,
    /// The hands on the body.
    pub hands: Vec<HandView>,
    /// What the body touches. `None` if it has touched nothing since its header was opened.
    pub contact: Option<ContactView>,
    /// Whether the body's header is closed, so that the fields shown below the header need not be
    /// filled in. [`show`] sets this for the next frame. A body that is folded when it is first
    /// shown starts with a closed header.
    pub folded: bool,
    /// Set when "Wake" was pressed.
    pub wake: bool,
    /// Set when "Let go" was pressed.
    pub release: bool,
}

/// A hand on a body.
#[derive(Debug, Clone, Default)]
pub struct HandView {
    /// Name of the hand's user.
    pub name: String,
    /// Color of the hand's user, sRGB. `None` selects one of the plot's own colors.
    pub color: Option<[u8; 3]>,
    /// Whether this app holds the grab, so that "Let go" can release it.
    pub releasable: bool,
    /// Magnitude of the reaction, N.
    pub force: f64,
    /// Magnitude of the reaction over the last seconds, N.
    pub forces: Trace,
}

/// What a body touches: floors, obstacles, other bodies.
#[derive(Debug, Clone, Default)]
pub struct ContactView {
    /// Number of places where the body touches something.
    pub places: usize,
    /// Number of those places that slide.
    pub sliding: usize,
    /// Magnitude of the sum of the forces on the body, N.
    pub force: f64,
    /// Depth of the deepest place inside the other, m.
    pub depth: f64,
    /// Magnitude of the sum of the forces over the last seconds, N.
    pub forces: Trace,
}

/// Shows `bodies`, each under its own header.
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
                // The header was opened in this frame: its fields are not filled in, and no knob
                // can have changed.
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
        let reduced = body.settings.elasticity == Elasticity::Reduced && !body.material.is_empty();
        if body.material.is_empty() {
            ui.weak("linear elasticity")
                .on_hover_text("The model was baked without a material for large strains.");
        } else {
            let mut on = reduced;
            ui.checkbox(&mut on, format!("reduced elasticity, {}", body.material))
                .on_hover_text("Forces of large strains; off is linear, which costs a hundredth.");
            if on != reduced {
                body.settings.elasticity = if on { Elasticity::Reduced } else { Elasticity::Linear };
            }
        }
        ui.add_enabled(!reduced, Checkbox::new(&mut body.settings.warp, "modal warping"))
            .on_hover_text("Right for large rotations; off is the plain linear shape.");
    });
    ui.horizontal(|ui| {
        ui.label(format!("{} Hz \u{b7} {} J", short(body.lowest_hz), short(body.energy)));
        if let Some(step) = body.step_us {
            ui.label(format!("\u{b7} {} \u{b5}s a step", short(step)))
                .on_hover_text("What its elasticity, its hands and its contacts take.");
        }
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
    if let Some(contact) = &body.contact {
        let ContactView { places, sliding, force, depth, forces } = contact;
        let (force, depth) = (short(*force), short(1e3 * depth));
        ui.label(format!("contacts: {places} ({sliding} slide) \u{b7} {force} N \u{b7} {depth} mm deep"))
            .on_hover_text("The sum of the forces on the body where it touches, and its deepest place.");
        plot(ui, &format!("pliant contact {index}"), "N", [("contact", forces, color(1))]);
    }
}
