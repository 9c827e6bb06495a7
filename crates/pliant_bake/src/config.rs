//! Input and output of a bake: the configuration, the stages and the times.

use std::path::PathBuf;

use pliant_modal::{Damping, Element, Material, ModalModel};

use crate::{Anchor, BakeError, Paint, Region, region};

const _: () = assert!(
    ModalModel::MAX_MODES == 4096 && ModalModel::MAX_TEXT == 256 && ModalModel::MAX_ANCHORS == 64,
    "the messages in `check` say so"
);

/// Configuration of a bake. All numbers are in SI units.
#[derive(Clone, Debug, PartialEq)]
pub struct BakeConfig {
    /// Human-readable name that the model stores, at most [`ModalModel::MAX_TEXT`] bytes. Default:
    /// empty.
    pub name: String,
    /// Finite element. Default: [`Element::Tet10`].
    pub element: Element,
    /// Number of elastic modes to keep, or of all coordinates with a [`material`](Self::material).
    /// Default: [`BakeConfig::COORDINATES`], and [`BakeConfig::MODES`] for [`BakeConfig::linear`].
    pub modes: usize,
    /// Material for large strains, or `None` for linear elasticity only. Default: the stable
    /// neo-Hookean law. [`BakeConfig::linear`] has none.
    ///
    /// With a material the coordinates are the lowest modes (about a third of them) and the most
    /// important combinations of their derivatives, and the model has a reduced elastic energy
    /// beside its linear one. [`BakeConfig::COORDINATES`] are enough for most bodies, and
    /// [`BakeConfig::MAX_COORDINATES`] is the limit.
    pub material: Option<Material>,
    /// Young's modulus, 1e-3 to 1e15 Pa. Default: 1e5, a soft silicone.
    pub young: f64,
    /// Poisson ratio, -0.99 to 0.49999. Default: 0.4.
    ///
    /// Above 0.45 the pressure is averaged over nodes to avoid locking.
    pub poisson: f64,
    /// Density, 1e-6 to 1e7 kg/m^3. Default: 1000.
    pub density: f64,
    /// Damping of the modes: a ratio of 0 to 1000, or alpha of 0 to 1e9 1/s and beta of 0 to 1e3 s.
    ///
    /// Default: 3 % of critical damping in every mode.
    pub damping: Damping,
    /// Anchors, at most [`ModalModel::MAX_ANCHORS`]. A node is fixed when any anchor contains it.
    /// Default: none, a free body.
    pub anchors: Vec<Anchor>,
    /// Parts of the body that are stiffer, softer, heavier or lighter than the rest, at most 64.
    /// Default: none.
    pub regions: Vec<Region>,
    /// Stiffness, density and anchors that are painted on a surface. Default: none.
    pub paint: Option<Paint>,
    /// Number of surface sites for which the residual flexibility is baked, at most one per vertex.
    ///
    /// The sites are spread evenly. Default: `None`, one site at every vertex. For very large
    /// bodies, where that takes long, use 64 to 512.
    pub sites: Option<usize>,
    /// Radii of the patches at each site, as fractions of the body's largest extent.
    ///
    /// The flexibility is interpolated between these radii. Default: 0.02, 0.028, 0.04, 0.056,
    /// 0.08, 0.113, 0.16, 0.226, 0.32.
    pub site_radii: Vec<f64>,
    /// Folder that receives `K.mtx` and `M.mtx` (MatrixMarket). Default: none.
    ///
    /// The bake creates the folder when it does not exist.
    pub export_matrices: Option<PathBuf>,
}

impl Default for BakeConfig {
    fn default() -> Self {
        Self {
            name: String::new(),
            element: Element::Tet10,
            modes: Self::COORDINATES,
            material: Some(Material::default()),
            young: 1e5,
            poisson: 0.4,
            density: 1000.0,
            damping: Damping::Ratio(0.03),
            anchors: Vec::new(),
            regions: Vec::new(),
            paint: None,
            sites: None,
            site_radii: vec![0.02, 0.028, 0.04, 0.056, 0.08, 0.113, 0.16, 0.226, 0.32],
            export_matrices: None,
        }
    }
}

/// Error for a text that names no material.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("material `{text}`: expected neo-hookean, st-venant-kirchhoff or linear")]
pub struct MaterialSyntax {
    /// Received text, at most 80 characters of it.
    pub text: String,
}

impl BakeConfig {
    /// Number of coordinates that suits a model with a [`material`](Self::material): a step of such
    /// a body takes about a tenth of a millisecond.
    pub const COORDINATES: usize = 36;

    /// Number of modes that suits a model without a [`material`](Self::material).
    pub const MODES: usize = 60;

    /// Maximum number of coordinates of a model with a [`material`](Self::material).
    pub const MAX_COORDINATES: usize = 120;

    /// Returns the default with linear elasticity only: without a [`material`](Self::material), and
    /// with [`BakeConfig::MODES`] modes.
    ///
    /// Such a body has a smaller file and a cheaper step, for crowds and for bodies that hands do
    /// not lead far. Its forces are those of small strains.
    pub fn linear() -> Self {
        Self { modes: Self::MODES, material: None, ..Self::default() }
    }

    /// Returns the default with the material of this name: `neo-hookean`, `st-venant-kirchhoff`, or
    /// `linear` for [`BakeConfig::linear`].
    ///
    /// # Errors
    /// Returns [`MaterialSyntax`] for every other text.
    pub fn of_material(name: &str) -> Result<Self, MaterialSyntax> {
        let of = |material| Self { material: Some(material), ..Self::default() };
        match name {
            "linear" => Ok(Self::linear()),
            "neo-hookean" => Ok(of(Material::NeoHookean)),
            "st-venant-kirchhoff" => Ok(of(Material::StVenantKirchhoff)),
            _ => Err(MaterialSyntax { text: name.chars().take(80).collect() }),
        }
    }

    /// Returns the name of the material, as [`BakeConfig::of_material`] takes it.
    pub fn material_name(&self) -> String {
        self.material.map_or_else(|| "linear".to_owned(), |material| material.to_string())
    }

    /// Returns whether nothing fixes the body: neither an anchor nor a painting.
    pub fn is_free(&self) -> bool {
        self.anchors.is_empty() && !self.paint.as_ref().is_some_and(Paint::anchors)
    }

    /// Checks the numbers that do not depend on the mesh.
    ///
    /// [`bake()`](crate::bake()) runs this check first. A program may run the check before it makes
    /// a mesh.
    ///
    /// # Errors
    /// Returns [`BakeError::Parameter`] for a number that is not finite or is out of its range.
    /// Zero modes and more than [`ModalModel::MAX_MODES`] modes are out of range.
    pub fn check(&self) -> Result<(), BakeError> {
        let number = |name, expected, ok: bool, got| {
            if ok { Ok(()) } else { Err(BakeError::Parameter { name, expected, got }) }
        };
        // The ranges extend far beyond real materials, yet the arithmetic stays sound within them.
        // No range contains NaN.
        let young = self.young;
        number("Young's modulus", "1e-3 to 1e15 Pa", (1e-3..=1e15).contains(&young), young)?;
        let nu = self.poisson;
        // At both ends one of the moduli vanishes against the other, so the modes lose their
        // digits.
        number(
            "Poisson ratio",
            "-0.99 to 0.49999 (it lies above -1 and below 0.5)",
            (-0.99..=0.49999).contains(&nu),
            nu,
        )?;
        let sound = self.material.is_none() || self.modes <= Self::MAX_COORDINATES;
        number(
            "modes",
            "at most 120 coordinates with a material other than linear",
            sound,
            self.modes as f64,
        )?;
        let sound = self.material.is_none() || nu <= 0.45;
        number("Poisson ratio", "at most 0.45 with a material other than linear", sound, nu)?;
        number("density", "1e-6 to 1e7 kg/m^3", (1e-6..=1e7).contains(&self.density), self.density)?;
        match self.damping {
            Damping::Rayleigh { alpha, beta } => {
                number("Rayleigh alpha", "0 to 1e9 1/s", (0.0..=1e9).contains(&alpha), alpha)?;
                number("Rayleigh beta", "0 to 1e3 s", (0.0..=1e3).contains(&beta), beta)?;
            }
            Damping::Ratio(zeta) => {
                number("damping ratio", "0 to 1000", (0.0..=1e3).contains(&zeta), zeta)?;
            }
            // This crate does not know newer damping laws. The model's own check validates their
            // coefficients.
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
        region::check(self)?;
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

/// Stage of a bake that reports its progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Makes the elements and the ordering and assembles stiffness and mass.
    Assemble,
    /// Computes the sparse Cholesky factorization.
    Factor,
    /// Runs the eigensolver.
    Modes,
    /// Chooses the points at which the energy of a material is integrated.
    Material,
    /// Computes the residual flexibility and the surface data.
    Surface,
}

/// Wall-clock time of each stage of a bake, s.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BakeTimes {
    /// Time for elements, ordering, stiffness and mass, s.
    pub assemble: f64,
    /// Time for the symbolic and numeric factorization, s.
    pub factor: f64,
    /// Time for the eigensolver, s.
    pub modes: f64,
    /// Time for the derivatives of the modes and the cubature of a material, s.
    pub material: f64,
    /// Time for the residual flexibility, the surface bases and the model itself, s.
    pub surface: f64,
    /// Time of all stages together, s.
    pub total: f64,
}

/// Result of a finished bake.
#[derive(Clone, Debug)]
pub struct Bake {
    /// Baked model.
    pub model: ModalModel,
    /// Time that the bake took.
    pub times: BakeTimes,
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use pliant_mesh::shapes;
    use pliant_modal::{Body, BodyConfig, GrabConfig, Patch};

    use super::*;
    use crate::bake;

    /// Extreme values that `check` accepts can be baked, grabbed and stepped.
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
                    ..BakeConfig::linear()
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
