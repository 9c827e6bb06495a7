//! What a bake is asked for.

use std::path::PathBuf;

use pliant_modal::{Damping, Element, ModalModel};

use crate::{Anchor, BakeError};

const _: () = assert!(ModalModel::MAX_MODES == 4096, "the message in `check` says 4096");

/// What to make of a mesh. All numbers in SI units.
#[derive(Clone, Debug, PartialEq)]
pub struct BakeConfig {
    /// A name for people, kept in the model. Default: empty.
    pub name: String,
    /// The finite element. Default: [`Element::Tet10`].
    pub element: Element,
    /// Elastic modes to keep. Default: 60.
    pub modes: usize,
    /// Young's modulus, Pa. Default: 1e5, a soft silicone.
    pub young: f64,
    /// Poisson ratio, above -1 and below 0.5. Default: 0.4. Above 0.45 the pressure is averaged over nodes, so that
    /// nothing locks.
    pub poisson: f64,
    /// Density, kg/m^3. Default: 1000.
    pub density: f64,
    /// How the modes lose energy. Default: 3 % of critical damping in every mode.
    pub damping: Damping,
    /// What is held fixed; the union of all. Default: none, a free body.
    pub anchors: Vec<Anchor>,
    /// For how many places on the surface the residual flexibility is baked, spread evenly; at most one a vertex.
    /// Default: `None`, as many as a second of one core gives, from 64 to 512.
    pub sites: Option<usize>,
    /// Radii of the patches at each of these places, as shares of the body's largest extent. Default: 0.03, 0.06, 0.12.
    pub site_radii: Vec<f64>,
    /// Folder that gets `K.mtx` and `M.mtx` (MatrixMarket); made when it is not there. Default: none.
    pub export_matrices: Option<PathBuf>,
}

impl Default for BakeConfig {
    fn default() -> Self {
        Self {
            name: String::new(),
            element: Element::Tet10,
            modes: 60,
            young: 1e5,
            poisson: 0.4,
            density: 1000.0,
            damping: Damping::Ratio(0.03),
            anchors: Vec::new(),
            sites: None,
            site_radii: vec![0.03, 0.06, 0.12],
            export_matrices: None,
        }
    }
}

impl BakeConfig {
    /// Checks the numbers that need no mesh. [`bake()`](crate::bake()) does so first; a program may before it makes a mesh.
    ///
    /// # Errors
    /// [`BakeError::Parameter`] for a number that is not finite or not in its range, for no modes
    /// or more than [`ModalModel::MAX_MODES`] too.
    pub fn check(&self) -> Result<(), BakeError> {
        let number = |name, expected, ok: bool, got| {
            if ok { Ok(()) } else { Err(BakeError::Parameter { name, expected, got }) }
        };
        let positive = |x: f64| x.is_finite() && x > 0.0;
        let not_negative = |x: f64| x.is_finite() && x >= 0.0;
        number("Young's modulus", "a finite number of Pa above 0", positive(self.young), self.young)?;
        let nu = self.poisson;
        number("Poisson ratio", "a number above -1 and below 0.5", nu > -1.0 && nu < 0.5, nu)?;
        number("density", "a finite number of kg/m^3 above 0", positive(self.density), self.density)?;
        match self.damping {
            Damping::Rayleigh { alpha, beta } => {
                number("Rayleigh alpha", "a finite number of 1/s, 0 or more", not_negative(alpha), alpha)?;
                number("Rayleigh beta", "a finite number of s, 0 or more", not_negative(beta), beta)?;
            }
            Damping::Ratio(zeta) => {
                number("damping ratio", "a finite number, 0 or more", not_negative(zeta), zeta)?;
            }
            // A law that is younger than this crate: the model's own check has the last word on its coefficients.
            _ => {}
        }
        for &radius in &self.site_radii {
            number(
                "site radius",
                "a share of the size above 0, at most 1",
                positive(radius) && radius <= 1.0,
                radius,
            )?;
        }
        if self.modes == 0 || self.modes > ModalModel::MAX_MODES {
            return Err(BakeError::Parameter {
                name: "modes",
                expected: "1 to 4096",
                got: self.modes as f64,
            });
        }
        Ok(())
    }
}

/// The parts of a bake that report their progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Elements, ordering, stiffness and mass.
    Assemble,
    /// The sparse Cholesky factorisation.
    Factor,
    /// The eigensolver.
    Modes,
    /// Residual flexibility and what the surface needs.
    Surface,
}

/// Seconds spent.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BakeTimes {
    /// Elements, ordering, stiffness and mass.
    pub assemble: f64,
    /// Symbolic and numeric factorisation.
    pub factor: f64,
    /// The eigensolver.
    pub modes: f64,
    /// Residual flexibility, surface bases, the model itself.
    pub surface: f64,
    /// All of it.
    pub total: f64,
}

/// A finished bake.
#[derive(Clone, Debug)]
pub struct Bake {
    /// The model.
    pub model: ModalModel,
    /// How long it took.
    pub times: BakeTimes,
}
