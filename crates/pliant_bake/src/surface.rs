//! The visible surface and the mode shapes on it.

use pliant_mesh::{Surface, TetMesh};
use pliant_modal::tetrahedron::{self, MAX_NODES};
use pliant_modal::{SurfaceMesh, VertexPlace};
use rayon::prelude::*;

use crate::BakeError;
use crate::embedding::Locator;
use crate::fem::{ANCHORED, FeMesh, Lists};

/// Largest distance between a skin vertex and the tetrahedra, as a fraction of the body's largest
/// extent.
const SKIN_REACH: f64 = 0.1;

/// Surface whose vertex displacements and rotations are linear combinations of nodal values.
#[derive(Clone, Debug)]
pub(crate) struct Skin {
    pub(crate) mesh: SurfaceMesh,
    /// Places of the vertices in the tetrahedra.
    pub(crate) places: Vec<VertexPlace>,
    displacement: Vec<Vec<(u32, f64)>>,
    rotation: Vec<Vec<(u32, f64)>>,
}

impl Skin {
    /// Uses the boundary of the tetrahedra, or embeds `skin` in them.
    ///
    /// The shape functions interpolate the displacements of an embedded skin. Outside the
    /// tetrahedra the displacements are extrapolated linearly from the nearest point of the mesh.
    pub(crate) fn new(
        tets: &TetMesh,
        mesh: &FeMesh,
        skin: Option<&Surface>,
        number: &[u32],
    ) -> Result<Self, BakeError> {
        let (surface, displacement, rotation, places) = match skin {
            None => {
                let (surface, nodes) = tets.boundary();
                let own: Vec<Vec<(u32, f64)>> = nodes.iter().map(|&n| vec![(n, 1.0)]).collect();
                let mut place = vec![VertexPlace::default(); tets.nodes.len()];
                for (element, corners) in tets.tets.iter().enumerate() {
                    for (k, &corner) in corners.iter().enumerate() {
                        let at = std::array::from_fn(|i| f32::from(u8::from(i + 1 == k)));
                        place[corner as usize] =
                            VertexPlace { element: element as u32, at, offset: [0.0; 3] };
                    }
                }
                let places = nodes.iter().map(|&node| place[node as usize]).collect();
                (surface, own.clone(), own, places)
            }
            Some(skin) => {
                skin.check().map_err(BakeError::Skin)?;
                let (displacement, rotation, places) = embed(mesh, skin)?;
                (skin.clone(), displacement, rotation, places)
            }
        };
        let anchored = displacement
            .iter()
            .map(|row| row.iter().all(|&(node, weight)| weight == 0.0 || number[node as usize] == ANCHORED))
            .collect();
        let positions = surface.positions.iter().map(|p| p.map(|x| x as f32)).collect();
        let mesh = SurfaceMesh::new(positions, surface.triangles, surface.uvs, anchored)?;
        Ok(Self { mesh, places, displacement, rotation })
    }

    /// Returns the lowest matrix row that moves `vertex`, or `ANCHORED` when no row does.
    pub(crate) fn first_row(&self, vertex: u32, number: &[u32]) -> u32 {
        let rows = self.displacement[vertex as usize].iter().map(|&(node, _)| number[node as usize]);
        rows.min().unwrap_or(ANCHORED)
    }

    /// Distributes a load of `weight` at `vertex` over the nodes. Calls `visit(node, share)` for
    /// each node.
    pub(crate) fn spread(&self, vertex: u32, weight: f64, visit: &mut dyn FnMut(u32, f64)) {
        for &(node, share) in &self.displacement[vertex as usize] {
            visit(node, weight * share);
        }
    }

    /// Returns the mode shapes at the vertices as `[mode][vertex][axis]`.
    ///
    /// `phi` has one row per free degree of freedom and one column per mode.
    pub(crate) fn displacements(&self, phi: &[f64], modes: usize, number: &[u32]) -> Vec<f32> {
        let node = |node: u32, mode: usize, axis: usize| {
            let row = number[node as usize];
            if row == ANCHORED { 0.0 } else { phi[(3 * row as usize + axis) * modes + mode] }
        };
        gather(&self.displacement, modes, &node)
    }

    /// Returns half the curl of the mode shapes at the vertices as `[mode][vertex][axis]`.
    ///
    /// The value at a node is the volume-weighted mean over the node's elements. The corner values
    /// are then interpolated linearly to the vertices.
    pub(crate) fn rotations(&self, mesh: &FeMesh, phi: &[f64], modes: usize, number: &[u32]) -> Vec<f32> {
        let around = mesh.elements_of_nodes();
        let mut place = vec![u32::MAX; mesh.nodes.len()];
        let mut nodes: Vec<u32> = Vec::new();
        for &(node, _) in self.rotation.iter().flatten() {
            if place[node as usize] == u32::MAX {
                place[node as usize] = nodes.len() as u32;
                nodes.push(node);
            }
        }
        let curls: Vec<Vec<f64>> =
            nodes.par_iter().map(|&node| half_curl(mesh, &around, node, phi, modes, number)).collect();
        let at = |node: u32, mode: usize, axis: usize| curls[place[node as usize] as usize][3 * mode + axis];
        gather(&self.rotation, modes, &at)
    }
}

fn gather(
    rows: &[Vec<(u32, f64)>],
    modes: usize,
    value: &(dyn Fn(u32, usize, usize) -> f64 + Sync),
) -> Vec<f32> {
    let mut out = vec![0.0f32; 3 * rows.len() * modes];
    out.par_chunks_mut(3 * rows.len()).enumerate().for_each(|(mode, out)| {
        for (row, out) in rows.iter().zip(out.chunks_exact_mut(3)) {
            for (axis, out) in out.iter_mut().enumerate() {
                *out = row.iter().map(|&(node, w)| w * value(node, mode, axis)).sum::<f64>() as f32;
            }
        }
    });
    out
}

/// Returns `1/2 curl u` of each mode at a node, three numbers per mode.
fn half_curl(
    mesh: &FeMesh,
    around: &Lists,
    node: u32,
    phi: &[f64],
    modes: usize,
    number: &[u32],
) -> Vec<f64> {
    let per = mesh.element.node_count();
    let mut out = vec![0.0; 3 * modes];
    let mut volume = 0.0;
    for &e in around.of(node as usize) {
        let nodes = &mesh.connectivity[e as usize * per..][..per];
        let local = nodes.iter().position(|&n| n == node).unwrap_or(0);
        let affine = &mesh.affine[e as usize];
        let gradients = affine.shape_gradients(mesh.element, corner_or_middle(local));
        volume += affine.volume;
        for (&n, g) in nodes.iter().zip(&gradients) {
            let row = number[n as usize];
            if row == ANCHORED {
                continue;
            }
            let u = &phi[3 * row as usize * modes..][..3 * modes];
            for (mode, out) in out.chunks_exact_mut(3).enumerate() {
                let u = [u[mode], u[modes + mode], u[2 * modes + mode]];
                let curl = tetrahedron::cross(*g, u);
                for k in 0..3 {
                    out[k] += 0.5 * affine.volume * curl[k];
                }
            }
        }
    }
    for x in &mut out {
        *x /= volume;
    }
    out
}

fn corner_or_middle(local: usize) -> [f64; 4] {
    let mut l = [0.0; 4];
    if local < 4 {
        l[local] = 1.0;
    } else {
        for a in tetrahedron::EDGES[local - 4] {
            l[a] = 0.5;
        }
    }
    l
}

type Rows = Vec<Vec<(u32, f64)>>;

fn embed(mesh: &FeMesh, skin: &Surface) -> Result<(Rows, Rows, Vec<VertexPlace>), BakeError> {
    let locator = Locator::new(mesh);
    let size = {
        let [low, high] = [f64::min, f64::max].map(|pick| {
            mesh.nodes.iter().skip(1).fold(mesh.nodes[0], |a, b| [0, 1, 2].map(|k| pick(a[k], b[k])))
        });
        (0..3).map(|k| high[k] - low[k]).fold(0.0, f64::max)
    };
    let per = mesh.element.node_count();
    let rows: Result<Vec<_>, BakeError> = skin
        .positions
        .par_iter()
        .enumerate()
        .map(|(vertex, &at)| {
            let allowed = SKIN_REACH * size;
            let far = |distance| BakeError::SkinFar { vertex, at, distance, allowed };
            let place = locator.find(at).ok_or_else(|| far(f64::INFINITY))?;
            if place.distance() > allowed {
                return Err(far(place.distance()));
            }
            let nodes = &mesh.connectivity[place.element * per..][..per];
            let shape = tetrahedron::shape(mesh.element, place.barycentric);
            let gradients = mesh.affine[place.element].shape_gradients(mesh.element, place.barycentric);
            let displacement = (0..per)
                .map(|i| (nodes[i], shape[i] + tetrahedron::dot(gradients[i], place.offset)))
                .filter(|(_, w)| *w != 0.0)
                .collect();
            let rotation =
                (0..4).map(|a| (nodes[a], place.barycentric[a])).filter(|(_, w)| *w != 0.0).collect();
            let [_, at @ ..] = place.barycentric.map(|x| x as f32);
            let offset = place.offset.map(|x| x as f32);
            Ok((displacement, rotation, VertexPlace { element: place.element as u32, at, offset }))
        })
        .collect();
    Ok(rows?.into_iter().collect())
}

const _: () = assert!(MAX_NODES == 10, "`corner_or_middle` knows corners and mid-edge nodes");
