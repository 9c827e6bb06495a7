//! What a bake is asked for.

use std::path::PathBuf;

use pliant_modal::{Damping, Element, ModalModel};

use crate::{Anchor, BakeError};

const _: () = assert!(
    ModalModel::MAX_MODES == 4096 && ModalModel::MAX_TEXT == 256 && ModalModel::MAX_ANCHORS == 64,
    "the messages in `check` say so"
);

/// What to make of a mesh. All numbers in SI units.
#[derive(Clone, Debug, PartialEq)]
pub struct BakeConfig {
    /// A name for people, kept in the model; at most [`ModalModel::MAX_TEXT`] bytes. Default: empty.
    pub name: String,
    /// The finite element. Default: [`Element::Tet10`].
    pub element: Element,
    /// Elastic modes to keep. Default: 60.
    pub modes: usize,
    /// Young's modulus, 1e-3 to 1e15 Pa. Default: 1e5, a soft silicone.
    pub young: f64,
    /// Poisson ratio, -0.99 to 0.49999. Default: 0.4. Above 0.45 the pressure is averaged over nodes, so that
    /// nothing locks.
    pub poisson: f64,
    /// Density, 1e-6 to 1e7 kg/m^3. Default: 1000.
    pub density: f64,
    /// How the modes lose energy: a ratio of 0 to 1000, or alpha of 0 to 1e9 1/s and beta of 0 to 1e3 s. Default: 3 % of critical damping in every mode.
    pub damping: Damping,
    /// What is held fixed; the union of all, at most [`ModalModel::MAX_ANCHORS`]. Default: none, a free body.
    pub anchors: Vec<Anchor>,
    /// For how many places on the surface the residual flexibility is baked, spread evenly; at most one a vertex.
    /// Default: `None`, one at every vertex; for very large bodies, where that would take long, 64 to 512.
    pub sites: Option<usize>,
    /// Radii of the patches at each of these places, as shares of the body's largest extent. Between them the flexibility is interpolated.
    /// Default: 0.02, 0.028, 0.04, 0.056, 0.08, 0.113, 0.16.
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
            site_radii: vec![0.02, 0.028, 0.04, 0.056, 0.08, 0.113, 0.16],
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
        // Far beyond anything that exists, near enough for the arithmetic to be sound. NaN is in no range.
        let young = self.young;
        number("Young's modulus", "1e-3 to 1e15 Pa", (1e-3..=1e15).contains(&young), young)?;
        let nu = self.poisson;
        // At both ends one of the moduli vanishes against the other, and with it the digits of the modes.
        number(
            "Poisson ratio",
            "-0.99 to 0.49999 (it lies above -1 and below 0.5)",
            (-0.99..=0.49999).contains(&nu),
            nu,
        )?;
        number("density", "1e-6 to 1e7 kg/m^3", (1e-6..=1e7).contains(&self.density), self.density)?;
        match self.damping {
            Damping::Rayleigh { alpha, beta } => {
                number("Rayleigh alpha", "0 to 1e9 1/s", (0.0..=1e9).contains(&alpha), alpha)?;
                number("Rayleigh beta", "0 to 1e3 s", (0.0..=1e3).contains(&beta), beta)?;
            }
            Damping::Ratio(zeta) => {
                number("damping ratio", "0 to 1000", (0.0..=1e3).contains(&zeta), zeta)?;
            }
            // A law that is younger than this crate: the model's own check has the last word on its coefficients.
            _ => {}
        }
        for &radius in &self.site_radii {
            number(
                "site radius",
                "a share of the size above 0, at most 1",
                radius > 0.0 && radius <= 1.0,
                radius,
            )?;
        }
        let (name, anchors) = (self.name.len(), self.anchors.len());
        number("name", "at most 256 bytes", name <= ModalModel::MAX_TEXT, name as f64)?;
        number("anchors", "at most 64", anchors <= ModalModel::MAX_ANCHORS, anchors as f64)?;
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use pliant_mesh::shapes;
    use pliant_modal::{Body, BodyConfig, GrabConfig, Patch};

    use super::*;
    use crate::bake;

    /// The corners of what `check` lets through are baked, held and stepped.
    #[test]
    fn what_is_accepted_can_be_baked_and_stepped() {
        let mesh = shapes::bar([4, 2, 2], [0.4, 0.2, 0.2]).unwrap();
        let heavy = [Damping::Ratio(1e3), Damping::Rayleigh { alpha: 1e9, beta: 1e3 }];
        let mut cases: Vec<(f64, f64, f64, Damping)> = Vec::new();
        for young in [1e-3, 1e15] {
            for density in [1e-6, 1e7] {
                cases.extend([Damping::Ratio(0.0), heavy[0], heavy[1]].map(|d| (young, 0.3, density, d)));
            }
        }
        let usual = Damping::Ratio(0.03);
        cases.extend([1e2, 1e12].map(|young| (young, 0.3, 1000.0, usual)));
        cases.extend([-0.99, -0.9, 0.0, 0.4999, 0.49999].map(|poisson| (1e5, poisson, 1000.0, usual)));
        for (young, poisson, density, damping) in cases {
            for anchors in [vec![], vec!["x<0.01".parse().unwrap()]] {
                let config = BakeConfig {
                    modes: 8,
                    young,
                    poisson,
                    density,
                    damping,
                    anchors,
                    ..BakeConfig::default()
                };
                let case = format!("{config:?}");
                let made = bake(&mesh, None, &config, &mut |_, _| ());
                let model = Arc::new(made.unwrap_or_else(|error| panic!("{error}: {case}")).model);
                let mut body = Body::new(model.clone(), BodyConfig::default()).unwrap();
                let patch = Patch::around(model.surface(), 0, 0.05).unwrap();
                let grab = body.grab(&patch, GrabConfig::default()).unwrap();
                let start = body.grab_position(grab).unwrap();
                body.set_target(grab, [start[0], start[1] + 0.01, start[2]]).unwrap();
                for _ in 0..10 {
                    body.step().unwrap_or_else(|error| panic!("{error}: {case}"));
                }
            }
        }
    }
}
