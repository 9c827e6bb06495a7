//! Model of the hand on a virtual device: a mass with a damper and a spring to the target of the
//! arm (Hogan 1989; values in Kuchenbecker, Park and Niemeyer 2003).

/// A grip of the hand.
///
/// The ranges of the literature are: mass 0.05 to 0.6 kg, damping 1 to 10 N s/m, stiffness 50 to
/// 500 N/m. The presets include the hard cases, a loose grip and no hand at all.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandModel {
    /// Mass that moves with the handle, kg.
    pub mass: f64,
    /// Damping toward the target of the arm, N s/m.
    pub damping: f64,
    /// Stiffness toward the target of the arm, N/m.
    pub stiffness: f64,
}

impl HandModel {
    /// A fist around the handle.
    pub const FIRM: Self = Self { mass: 0.3, damping: 10.0, stiffness: 500.0 };
    /// The grip of a pen.
    pub const LIGHT: Self = Self { mass: 0.1, damping: 3.0, stiffness: 150.0 };
    /// Two fingertips.
    pub const LOOSE: Self = Self { mass: 0.05, damping: 1.0, stiffness: 50.0 };
    /// No hand on the device.
    pub const NONE: Self = Self { mass: 0.0, damping: 0.0, stiffness: 0.0 };

    /// All presets by name.
    pub const PRESETS: [(&'static str, Self); 4] =
        [("firm", Self::FIRM), ("light", Self::LIGHT), ("loose", Self::LOOSE), ("none", Self::NONE)];

    pub(crate) fn is_valid(&self) -> bool {
        [self.mass, self.damping, self.stiffness].iter().all(|x| x.is_finite() && *x >= 0.0)
    }
}
