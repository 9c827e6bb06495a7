//! A body with the modes of a rod in closed form, the same on all three axes. The rod is fixed at
//! one end and free at the other, at `x = L`: `phi_k = sqrt(2 / m) sin(k_k x)`,
//! `k_k = (2k - 1) pi / (2L)`, `omega_k = k_k sqrt(E / rho)`.

use std::f64::consts::FRAC_PI_2;

use pliant_modal::{BakeInfo, Damping, Element, FlexibilitySite, ModalModel, ModelParts, SurfaceMesh};

pub const DENSITY: f64 = 1000.0;

pub struct Rod {
    pub name: &'static str,
    /// Which axis the rod is along.
    pub along: usize,
    /// m and kg.
    pub length: f64,
    pub mass: f64,
    /// Young's modulus, Pa.
    pub young: f64,
    /// Number of modes along each axis, and their damping ratio.
    pub each: usize,
    pub zeta: f64,
    /// Moment of inertia about all axes, kg m^2.
    pub inertia: f64,
}

impl Rod {
    fn wave(&self, k: usize) -> f64 {
        (2 * k + 1) as f64 * FRAC_PI_2 / self.length
    }

    fn omega(&self, k: usize) -> f64 {
        self.wave(k) * (self.young / DENSITY).sqrt()
    }

    /// Displacement of the free end for a force there as far as the modes have it, m/N.
    pub fn compliance(&self) -> f64 {
        (0..self.each).map(|k| 2.0 / self.mass / self.omega(k).powi(2)).sum()
    }

    /// Makes the model of a surface, whose vertices at 0 along the rod are fixed.
    pub fn model(
        &self,
        positions: Vec<[f32; 3]>,
        triangles: Vec<[u32; 3]>,
        sites: Vec<FlexibilitySite>,
    ) -> ModalModel {
        let size = (2.0 / self.mass).sqrt();
        let (mut omega, mut displacement, mut participation) = (Vec::new(), Vec::new(), Vec::new());
        for (k, axis) in (0..self.each).flat_map(|k| (0..3).map(move |axis| (k, axis))) {
            omega.push(self.omega(k));
            for p in &positions {
                let mut row = [0.0f32; 3];
                row[axis] = (size * (self.wave(k) * f64::from(p[self.along]).min(self.length)).sin()) as f32;
                displacement.extend(row);
            }
            let mut part = [0.0; 3];
            part[axis] = size * self.mass / (self.wave(k) * self.length);
            participation.push(part);
        }
        let anchored = positions.iter().map(|p| p[self.along] == 0.0).collect();
        let mut center_of_mass = [0.0; 3];
        center_of_mass[self.along] = 0.5 * self.length;
        let inertia = self.inertia;
        ModalModel::from_parts(ModelParts {
            info: BakeInfo {
                name: self.name.into(),
                tets: 0,
                nodes: 0,
                element: Element::Tet10,
                young: self.young,
                poisson: 0.3,
                density: DENSITY,
                damping: Damping::Ratio(self.zeta),
                anchors: vec![format!("{}<=0", ["x", "y", "z"][self.along])],
                residual_max: 0.0,
                orthonormality_max: 0.0,
            },
            surface: SurfaceMesh::new(positions, triangles, None, anchored).unwrap(),
            damping: omega.iter().map(|w| 2.0 * self.zeta * w).collect(),
            rotation: vec![0.0; displacement.len()],
            displacement,
            omega,
            participation,
            free: false,
            mass: self.mass,
            center_of_mass,
            inertia: [[inertia, 0.0, 0.0], [0.0, inertia, 0.0], [0.0, 0.0, inertia]],
            sites,
            reduced: None,
        })
        .unwrap()
    }
}
