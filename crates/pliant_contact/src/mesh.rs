//! Convex hulls and triangle meshes as obstacles.

use std::collections::{BTreeMap, BTreeSet, btree_map::Entry as Slot};
use std::sync::Arc;

use bevy::{
    math::DVec3,
    prelude::*,
    tasks::{AsyncComputeTaskPool, Task, block_on, poll_once},
};
use nalgebra::Vector3;
use parry3d_f64::{
    math::Vector,
    query::PointQueryWithLocation,
    shape::{TriMesh, TriMeshFlags},
    transformation::{ConvexHullError, try_convex_hull},
};
use pliant_body::MeshTriangles;
use pliant_modal as modal;
use pliant_modal::StepError;

use crate::obstacle::FAR;

/// The triangles of an obstacle in its own axes, m, with the scale of its entity.
#[derive(Debug)]
pub(crate) struct Solid {
    triangles: TriMesh,
    /// Whether the triangles enclose what is solid.
    pub(crate) closed: bool,
    /// Distance below which the direction to the closest point is rounding error, m.
    tiny: f64,
}

impl modal::ObstacleShape for Solid {
    fn at(&self, point: &Vector3<f64>) -> modal::SurfacePoint {
        let p = Vector::new(point.x, point.y, point.z);
        let found = self.triangles.project_local_point_and_get_location_with_max_dist(p, false, f64::MAX);
        let Some((closest, (triangle, _))) = found.filter(|_| p.is_finite()) else {
            return modal::SurfacePoint { distance: FAR, normal: Vector3::y() };
        };
        let way = p - closest.point;
        let length = way.length();
        let sign = if closest.is_inside { -1.0 } else { 1.0 };
        // On the surface itself the triangle gives the direction.
        let normal = if length > self.tiny {
            way * (sign / length)
        } else {
            self.triangles.triangle(triangle).normal().unwrap_or(Vector::Y)
        };
        modal::SurfacePoint { distance: sign * length, normal: Vector3::new(normal.x, normal.y, normal.z) }
    }
}

impl Solid {
    /// Makes the solid of a mesh with the scale of its entity.
    pub(crate) fn new(source: &Source, scale: DVec3) -> Result<Self, StepError> {
        let points: Vec<DVec3> = source.positions.iter().map(|p| Vec3::from(*p).as_dvec3() * scale).collect();
        let bad = points.iter().find(|p| !p.is_finite());
        check("position in an obstacle's mesh", "finite numbers", bad.is_none(), f64::NAN)?;
        let (points, mut triangles) = weld(&points, &source.triangles);
        let mut points: Vec<Vector> = points.iter().map(|p| Vector::new(p.x, p.y, p.z)).collect();
        let count = triangles.len();
        check("triangles of an obstacle's mesh", "1 or more that are not flat", count > 0, count as f64)?;
        if source.hull {
            let fail = |_| StepError::Input {
                what: "points of an obstacle's hull",
                expected: "4 or more, not all in one plane",
                got: points.len() as f64,
            };
            // Some of its checks are assertions.
            let made = std::panic::catch_unwind(|| try_convex_hull(&points).map_err(fail));
            (points, triangles) = made.unwrap_or_else(|_| Err(fail(ConvexHullError::Unreachable)))?;
        }
        // A closed mesh may have been made inside out, and a mirrored one is.
        let (volume, size) = (volume(&points, &triangles), size(&points));
        let closed = is_closed(&triangles);
        if closed {
            if volume < 0.0 {
                triangles.iter_mut().for_each(|t| t.swap(1, 2));
            }
        } else if scale.x * scale.y * scale.z < 0.0 {
            triangles.iter_mut().for_each(|t| t.swap(1, 2));
        }
        let thick = volume.abs() > 1e-9 * size.powi(3);
        check("volume of an obstacle's hull", "more than 0", thick || !source.hull, volume)?;
        let triangles =
            TriMesh::with_flags(points, triangles, TriMeshFlags::ORIENTED).map_err(|_| StepError::Input {
                what: "triangles of an obstacle's mesh",
                expected: "edges that at most two of them share, in opposite directions",
                got: count as f64,
            })?;
        Ok(Self { triangles, closed, tiny: 1e-12 * size })
    }
}

fn check(what: &'static str, expected: &'static str, ok: bool, got: f64) -> Result<(), StepError> {
    if ok { Ok(()) } else { Err(StepError::Input { what, expected, got }) }
}

/// Makes one of all vertices at the same place, and leaves out triangles without area. Places are
/// the same up to a millionth of the size: where a mesh is closed around an axis, its first and
/// last vertices differ by rounding.
fn weld(points: &[DVec3], triangles: &[[u32; 3]]) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let [low, high] = points
        .iter()
        .fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[low, high], p| [low.min(*p), high.max(*p)]);
    let near = (1e-6 * (high - low).length()).max(f64::MIN_POSITIVE);
    // A point within `near` lies in the same cell or in one beside it.
    let cell = |p: DVec3| ((p - low) / (2.0 * near)).as_i64vec3();
    let mut known: BTreeMap<[i64; 3], Vec<u32>> = BTreeMap::new();
    let mut kept: Vec<DVec3> = Vec::new();
    let mut welded: Vec<u32> = Vec::with_capacity(points.len());
    for p in points {
        let corner = |sign: f64| cell(*p + DVec3::splat(sign * near));
        let (from, to) = (corner(-1.0), corner(1.0));
        let cells = (from.x..=to.x)
            .flat_map(|x| (from.y..=to.y).flat_map(move |y| (from.z..=to.z).map(move |z| [x, y, z])));
        let found = cells
            .filter_map(|cell| known.get(&cell))
            .flatten()
            .find(|v| (kept[**v as usize] - *p).length() <= near)
            .copied();
        welded.push(found.unwrap_or_else(|| {
            kept.push(*p);
            let v = kept.len() as u32 - 1;
            known.entry(cell(*p).to_array()).or_default().push(v);
            v
        }));
    }
    let all = triangles.iter().filter_map(|t| {
        let [a, b, c] = t.map(|v| welded.get(v as usize).copied());
        let (a, b, c) = (a?, b?, c?);
        let [p, q, r] = [a, b, c].map(|v| kept[v as usize]);
        let across = (q - p).cross(r - p).length();
        let longest = (q - p).length_squared().max((r - p).length_squared()).max((r - q).length_squared());
        (across > 1e-12 * longest).then_some([a, b, c])
    });
    let all = all.collect();
    (kept, all)
}

/// Whether each edge is shared by two triangles in opposite directions.
fn is_closed(triangles: &[[u32; 3]]) -> bool {
    let edges: BTreeSet<[u32; 2]> =
        triangles.iter().flat_map(|[a, b, c]| [[*a, *b], [*b, *c], [*c, *a]]).collect();
    edges.iter().all(|[a, b]| edges.contains(&[*b, *a]))
}

/// Volume within the triangles, m^3, negative for those that are inside out.
fn volume(points: &[Vector], triangles: &[[u32; 3]]) -> f64 {
    let Some(origin) = points.first().copied() else { return 0.0 };
    let cone = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| points.get(v as usize).map_or(Vector::ZERO, |p| *p - origin));
        a.dot(b.cross(c)) / 6.0
    };
    triangles.iter().map(cone).sum()
}

/// Diagonal of the box around the points, m.
fn size(points: &[Vector]) -> f64 {
    let [low, high] = points
        .iter()
        .fold([Vector::INFINITY, Vector::NEG_INFINITY], |[low, high], p| [low.min(*p), high.max(*p)]);
    (high - low).length()
}

/// What a solid is made of.
pub(crate) struct Source {
    pub(crate) positions: Vec<[f32; 3]>,
    pub(crate) triangles: Vec<[u32; 3]>,
    pub(crate) hull: bool,
}

impl Source {
    pub(crate) fn new(mesh: &Mesh, hull: bool) -> Result<Self, StepError> {
        let unusable = |expected| StepError::Input { what: "an obstacle's mesh", expected, got: f64::NAN };
        let MeshTriangles { positions, triangles } = MeshTriangles::of(mesh).map_err(unusable)?;
        Ok(Self { positions, triangles, hull })
    }
}

/// What a solid is known by: the mesh, whether its hull is meant, and the bits of the scale.
type Key = (AssetId<Mesh>, bool, [u64; 3]);

enum Entry {
    Making(Task<Result<Solid, StepError>>),
    Made(Result<Arc<Solid>, StepError>),
}

/// The solids of all obstacles. Those with the same mesh and scale share one, which is made on
/// another thread.
#[derive(Resource, Default)]
pub(crate) struct Solids {
    entries: BTreeMap<Key, (Entry, bool)>,
}

impl Solids {
    /// Forgets the solids that nothing asked for since the last call, and those whose mesh has
    /// changed.
    pub(crate) fn tidy(&mut self, changed: impl Iterator<Item = AssetId<Mesh>>) {
        let changed: BTreeSet<AssetId<Mesh>> = changed.collect();
        self.entries.retain(|(mesh, ..), (_, used)| std::mem::take(used) && !changed.contains(mesh));
    }

    /// Returns the solid of a mesh, or `None` while the mesh is not loaded or the solid is not
    /// made.
    pub(crate) fn get(
        &mut self,
        meshes: &Assets<Mesh>,
        mesh: &Handle<Mesh>,
        hull: bool,
        scale: DVec3,
    ) -> Option<Result<Arc<Solid>, StepError>> {
        let key = (mesh.id(), hull, scale.to_array().map(f64::to_bits));
        let (entry, used) = match self.entries.entry(key) {
            Slot::Occupied(known) => known.into_mut(),
            Slot::Vacant(new) => {
                let entry = match Source::new(meshes.get(mesh)?, hull) {
                    Err(error) => Entry::Made(Err(error)),
                    Ok(source) => match AsyncComputeTaskPool::try_get() {
                        Some(pool) => Entry::Making(pool.spawn(async move { Solid::new(&source, scale) })),
                        None => Entry::Made(Solid::new(&source, scale).map(Arc::new)),
                    },
                };
                new.insert((entry, true))
            }
        };
        *used = true;
        if let Entry::Making(task) = entry {
            let made = block_on(poll_once(task))?;
            *entry = Entry::Made(made.map(Arc::new));
        }
        match entry {
            Entry::Made(made) => Some(made.clone()),
            Entry::Making(_) => None,
        }
    }
}
