//! Distance between two shapes on the surface.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use pliant_modal::ModalModel;
use pliant_stream::RigidState;

/// Approximate number of surface vertices at which shapes are compared.
const SAMPLES: usize = 48;

/// What is seen of a body at a tick. The default is the body at rest, where its model places it.
#[derive(Debug, Clone, Default)]
pub(super) struct Picture {
    /// Modal coordinates. What is missing counts as 0.
    pub(super) q: Vec<f64>,
    /// The pose of a free body. `None` for an anchored one.
    pub(super) pose: Option<RigidState>,
}

impl Picture {
    /// Folds every number into a hash.
    pub(super) fn fold(&self, hash: u64) -> u64 {
        let pose = self.pose.iter().flat_map(|pose| pose.position.iter().chain(&pose.rotation));
        self.q.iter().chain(pose).fold(hash, |hash, x| super::fold(hash, &x.to_bits().to_le_bytes()))
    }
}

/// A vertex of the surface: its place at rest, and the rows of its displacement.
struct Vertex {
    rest: Vector3<f64>,
    rows: Vec<[f64; 3]>,
}

impl Vertex {
    fn of(model: &ModalModel, vertex: usize) -> Self {
        let row = |mode: usize| -> [f64; 3] {
            std::array::from_fn(|a| f64::from(model.displacement_row(vertex as u32, a, mode)))
        };
        let rest = model.surface().positions().get(vertex).copied().unwrap_or_default();
        Self { rest: Vector3::from(rest.map(f64::from)), rows: (0..model.mode_count()).map(row).collect() }
    }

    /// How far the vertex is from its place at rest, m, world axes.
    fn displacement(&self, picture: &Picture) -> Vector3<f64> {
        let mut u = Vector3::zeros();
        for (row, q) in self.rows.iter().zip(&picture.q) {
            u += Vector3::from(*row) * *q;
        }
        let Some(pose) = &picture.pose else { return u };
        let [x, y, z, w] = pose.rotation;
        let turned = UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z)) * (self.rest + u);
        turned + Vector3::from(pose.position) - self.rest
    }
}

/// Compares shapes at evenly chosen surface vertices, a free body where its pose places it. The
/// shapes are unwarped, so that the same difference of coordinates counts the same in every shape.
pub(super) struct ShapeError {
    vertices: Vec<Vertex>,
}

impl ShapeError {
    pub(super) fn new(model: &ModalModel) -> Self {
        let vertices = model.surface().positions().len();
        let step = (vertices / SAMPLES).max(1);
        Self { vertices: (0..vertices).step_by(step).map(|v| Vertex::of(model, v)).collect() }
    }

    /// Compares at one vertex only.
    pub(super) fn at(model: &ModalModel, vertex: u32) -> Self {
        Self { vertices: vec![Vertex::of(model, vertex as usize)] }
    }

    /// Number of compared vertices.
    pub(super) fn places(&self) -> f64 {
        self.vertices.len().max(1) as f64
    }

    /// Displacement of the first compared vertex along an axis, m.
    pub(super) fn first(&self, axis: usize, picture: &Picture) -> f64 {
        self.vertices.first().map_or(0.0, |vertex| vertex.displacement(picture)[axis])
    }

    /// Sum and largest of the squared differences at the compared vertices, m^2.
    pub(super) fn compare(&self, a: &Picture, b: &Picture) -> (f64, f64) {
        let mut sums = (0.0, 0.0_f64);
        for vertex in &self.vertices {
            let s = (vertex.displacement(a) - vertex.displacement(b)).norm_squared();
            sums = (sums.0 + s, sums.1.max(s));
        }
        sums
    }

    /// Sum and largest of the squared displacements from rest, m^2.
    pub(super) fn size(&self, picture: &Picture) -> (f64, f64) {
        self.compare(picture, &Picture::default())
    }
}

#[cfg(test)]
mod tests {
    #![expect(clippy::unwrap_used, reason = "a failed test should panic")]
    use pliant_bake::{BakeConfig, bake};
    use pliant_mesh::shapes;

    use super::*;

    #[test]
    fn a_free_body_is_compared_where_its_pose_places_it() {
        let mesh = shapes::bar([4, 1, 1], [1.0, 0.2, 0.2]).unwrap();
        let config = BakeConfig { modes: 6, ..BakeConfig::linear() };
        let model = bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model;
        assert!(model.is_free());
        let shape = ShapeError::new(&model);
        let moved = |position, rotation| Picture {
            q: Vec::new(),
            pose: Some(RigidState { position, rotation, ..RigidState::default() }),
        };
        // A shift by 5 m moves every vertex by 5 m.
        let (sum, largest) = shape.size(&moved([3.0, 4.0, 0.0], [0.0, 0.0, 0.0, 1.0]));
        assert!((largest - 25.0).abs() < 1e-9 && (sum / shape.places() - 25.0).abs() < 1e-9, "{sum}");
        // Half a turn about z moves a vertex by twice its distance from the axis.
        let turned = moved([0.0; 3], [0.0, 0.0, 1.0, 0.0]);
        let step = (model.surface().positions().len() / SAMPLES).max(1);
        let from_axis = model.surface().positions().iter().step_by(step);
        let from_axis = from_axis.map(|p| f64::from(p[0]).powi(2) + f64::from(p[1]).powi(2));
        let want = 4.0 * from_axis.sum::<f64>();
        assert!((shape.size(&turned).0 / want - 1.0).abs() < 1e-6, "{} and {want}", shape.size(&turned).0);
        // The displacement turns with the body: the same coordinates differ in another pose.
        let bent = |pose| Picture { q: vec![0.1, 0.0, -0.05], pose };
        assert!(shape.compare(&bent(None), &bent(Some(RigidState::default()))).0 < 1e-24);
        assert!(shape.compare(&bent(turned.pose), &bent(None)).0 > 0.1 * want);
    }
}
