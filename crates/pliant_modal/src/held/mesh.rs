//! The simulation mesh of a model, with the coordinates at its nodes.

use crate::{ModelError, tetrahedron};

/// Place of a surface vertex in the simulation mesh.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct VertexPlace {
    /// Number of the tetrahedron.
    pub element: u32,
    /// The last three barycentric coordinates in it.
    pub at: [f32; 3],
    /// Vector from there to a vertex outside of the mesh, m. Displacements are extrapolated
    /// linearly along it.
    pub offset: [f32; 3],
}

/// Simulation mesh of a model with `m` coordinates, from which the own shapes of a held patch are
/// made (see [`HeldShapes`](crate::HeldShapes)).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SimulationMesh {
    /// Positions of the corners at rest, m.
    pub corners: Vec<[f32; 3]>,
    /// Corners of the tetrahedra. The elements are those of [`BakeInfo`](crate::BakeInfo).
    pub tets: Vec<[u32; 4]>,
    /// Largest displacement of each coordinate at a node along an axis, kg^-1/2, with `m` entries.
    pub scales: Vec<f32>,
    /// Displacements of the nodes, `[node][axis][coordinate]`, in units of the coordinate's scale
    /// over [`SimulationMesh::STEPS`]. Anchored nodes have zeros. The nodes are in the order of
    /// [`tetrahedron::connectivity`].
    pub displacements: Vec<i16>,
    /// Places of the surface vertices.
    pub vertices: Vec<VertexPlace>,
    /// Factor of the moduli of each tetrahedron. Empty where all have the same moduli.
    pub stiffness: Vec<f32>,
}

impl SimulationMesh {
    /// Number of steps of a displacement between zero and the coordinate's scale.
    pub const STEPS: f32 = 32_767.0;

    /// Maximum number of tetrahedra of a simulation mesh in a model.
    pub const MAX_TETS: usize = 65_536;

    /// Maximum number of [`SimulationMesh::displacements`] with which a bake puts the mesh into a
    /// model: 16 MiB, those of 36 coordinates at 77,000 nodes.
    pub const MAX_DISPLACEMENTS: usize = 8 << 20;

    /// Returns the scales and the displacements for values `[node][axis][coordinate]`, kg^-1/2.
    pub fn quantized(values: &[f64], coordinates: usize) -> (Vec<f32>, Vec<i16>) {
        let mut most = vec![0.0f64; coordinates];
        for row in values.chunks_exact(coordinates.max(1)) {
            most.iter_mut().zip(row).for_each(|(most, x)| *most = most.max(x.abs()));
        }
        let scales: Vec<f32> = most.iter().map(|&x| (x as f32).max(f32::MIN_POSITIVE)).collect();
        let step = |(x, scale): (&f64, &f32)| (x / f64::from(*scale) * f64::from(Self::STEPS)).round() as i16;
        let rows = values.chunks_exact(coordinates.max(1));
        (scales.clone(), rows.flat_map(|row| row.iter().zip(&scales).map(step)).collect())
    }

    /// Checks lengths, numbers and indices for a model of `modes` coordinates and `vertices`
    /// surface vertices.
    pub(crate) fn check(
        &self,
        element: crate::Element,
        modes: usize,
        vertices: usize,
    ) -> Result<(), ModelError> {
        let length = |what, expected: usize, got: usize| {
            if expected == got { Ok(()) } else { Err(ModelError::Length { what, expected, got }) }
        };
        let tets = self.tets.len();
        if tets == 0 {
            return Err(ModelError::Empty("tetrahedron"));
        }
        length("tetrahedra", tets.min(Self::MAX_TETS), tets)?;
        length("node scales", modes, self.scales.len())?;
        length("vertex places", vertices, self.vertices.len())?;
        if !self.stiffness.is_empty() {
            length("tetrahedra's stiffness", tets, self.stiffness.len())?;
        }
        let count = self.corners.len();
        for (index, tet) in self.tets.iter().enumerate() {
            if let Some(&vertex) = tet.iter().find(|&&corner| corner as usize >= count) {
                return Err(ModelError::Vertex { what: "tetrahedra", index, vertex, count });
            }
        }
        let (_, edges) = tetrahedron::connectivity(count, &self.tets, element);
        length("node displacements", 3 * modes * (count + edges.len()), self.displacements.len())?;
        let value = |what, expected, bad: Option<(usize, f32)>| match bad {
            None => Ok(()),
            Some((index, got)) => Err(ModelError::Value { what, index, expected, got: f64::from(got) }),
        };
        let finite = |x: &(usize, f32)| !x.1.is_finite();
        value("corners", "finite meters", self.corners.iter().flatten().copied().enumerate().find(finite))?;
        let positive = |x: &(usize, f32)| !(x.1.is_finite() && x.1 > 0.0);
        value("node scales", "above 0", self.scales.iter().copied().enumerate().find(positive))?;
        let mut stiffness = self.stiffness.iter().copied().enumerate();
        value("tetrahedra's stiffness", "above 0", stiffness.find(positive))?;
        for (index, place) in self.vertices.iter().enumerate() {
            if place.element as usize >= tets {
                return Err(ModelError::Vertex {
                    what: "vertex places",
                    index,
                    vertex: place.element,
                    count: tets,
                });
            }
            let bad = place.at.iter().chain(&place.offset).find(|x| !x.is_finite());
            value("vertex places", "finite", bad.map(|&got| (index, got)))?;
        }
        // The elements must have a volume, because the gradients are divided by it.
        let corner = |i: u32| self.corners.get(i as usize).copied().unwrap_or_default().map(f64::from);
        let flat = |t: &[u32; 4]| {
            let affine = tetrahedron::Affine::new(t.map(corner));
            !(affine.volume > 0.0 && affine.gradients.iter().flatten().all(|g| g.is_finite()))
        };
        match self.tets.iter().position(flat) {
            None => Ok(()),
            Some(index) => {
                let (what, expected) = ("tetrahedra", "volumes above 0");
                Err(ModelError::Value { what, index, expected, got: 0.0 })
            }
        }
    }
}

impl SimulationMesh {
    /// Writes the displacements of a node by the coordinates, `[axis][coordinate]`, kg^-1/2.
    pub(super) fn coordinates(&self, node: u32, out: &mut [f64]) {
        let modes = self.scales.len();
        let steps = self.displacements[3 * node as usize * modes..][..3 * modes].chunks_exact(modes);
        for (out, steps) in out.chunks_exact_mut(modes).zip(steps) {
            for ((out, step), scale) in out.iter_mut().zip(steps).zip(&self.scales) {
                *out = f64::from(*step) * f64::from(*scale / Self::STEPS);
            }
        }
    }

    /// Returns the factor of the moduli of a tetrahedron.
    pub(super) fn stiffness(&self, tet: u32) -> f64 {
        self.stiffness.get(tet as usize).map_or(1.0, |&factor| f64::from(factor))
    }

    /// Number of nodes.
    pub(super) fn node_count(&self) -> usize {
        self.displacements.len() / (3 * self.scales.len()).max(1)
    }

    /// Whether a node is anchored: no coordinate moves it.
    pub(super) fn is_anchored(&self, node: u32) -> bool {
        let modes = self.scales.len();
        self.displacements[3 * node as usize * modes..][..3 * modes].iter().all(|&step| step == 0)
    }
}
