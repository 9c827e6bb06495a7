use nalgebra::Rotation3;

use super::*;
use crate::{Surface, sdf::SurfaceDistance, shapes};

struct Ball(f64);

impl SignedDistance for Ball {
    fn distance(&self, p: [f64; 3]) -> f64 {
        Vector3::from(p).norm() - self.0
    }
    fn bounds(&self) -> [[f64; 3]; 2] {
        [[-self.0; 3], [self.0; 3]]
    }
}

struct Torus {
    ring: f64,
    tube: f64,
}

impl SignedDistance for Torus {
    fn distance(&self, [x, y, z]: [f64; 3]) -> f64 {
        (x.hypot(y) - self.ring).hypot(z) - self.tube
    }
    fn bounds(&self) -> [[f64; 3]; 2] {
        let r = self.ring + self.tube;
        [[-r, -r, -self.tube], [r, r, self.tube]]
    }
}

/// Box with these half extents.
struct Cuboid([f64; 3]);

impl SignedDistance for Cuboid {
    fn distance(&self, p: [f64; 3]) -> f64 {
        let q = Vector3::from(p).abs() - Vector3::from(self.0);
        q.sup(&Vector3::zeros()).norm() + q.max().min(0.0)
    }
    fn bounds(&self) -> [[f64; 3]; 2] {
        [self.0.map(|x| -x), self.0]
    }
}

/// Many balls that touch, overlap and miss each other. They form thin necks, fragments and
/// cavities.
struct Foam(Vec<(Vector3<f64>, f64)>);

impl Foam {
    fn new(seed: u32) -> Self {
        // Weyl sequences are evenly distributed and differ for each seed.
        let x = |n: u32, a: f64| (f64::from(n + 100 * seed) * a).fract();
        let ball = |n| {
            let center = Vector3::new(x(n, 0.819_172_513), x(n, 0.671_043_606), x(n, 0.549_700_478));
            (center, 0.04 + 0.12 * x(n, 0.754_877_666))
        };
        Self((1..60).map(ball).collect())
    }
}

impl SignedDistance for Foam {
    fn distance(&self, p: [f64; 3]) -> f64 {
        self.0.iter().map(|(c, r)| (Vector3::from(p) - c).norm() - r).fold(f64::INFINITY, f64::min)
    }
    fn bounds(&self) -> [[f64; 3]; 2] {
        [[-0.2; 3], [1.2; 3]]
    }
}

fn stuffed(sdf: &dyn SignedDistance, target: usize) -> TetMesh {
    stuff(sdf, &StuffOptions::with_target(target), &mut |_| ()).unwrap()
}

/// Checks the guarantees of the module for a mesh. Returns the boundary.
fn assert_sound(mesh: &TetMesh, sdf: &dyn SignedDistance, target: usize) -> Surface {
    mesh.check().unwrap();
    let count = mesh.tets.len();
    assert!(count.abs_diff(target) as f64 <= 0.05 * target as f64, "{count} tetrahedra, wanted {target}");
    // Labelle and Shewchuk 2007 prove bounds of 10.78 and 164.83 degrees.
    let quality = mesh.quality();
    assert!(quality.min_dihedral_deg > 10.7, "{quality:?}");
    assert!(quality.max_dihedral_deg < 164.85, "{quality:?}");
    let (surface, _) = mesh.boundary();
    // `closed` is not suitable here, because it merges the nodes of pieces that were separated
    // where they touched.
    surface.check_edges().unwrap();
    assert!((surface.volume() / mesh.volume() - 1.0).abs() < 1e-9, "the boundary bounds what is filled");
    assert_one_fan_at_each_vertex(&surface);
    let [low, high] = sdf.bounds().map(Vector3::from);
    for &p in &surface.positions {
        assert!(sdf.distance(p).abs() < 1e-8 * (high - low).norm(), "{p:?} is {} m off", sdf.distance(p));
    }
    surface
}

fn assert_one_fan_at_each_vertex(surface: &Surface) {
    let mut fans = vec![Vec::new(); surface.positions.len()];
    for &[a, b, c] in &surface.triangles {
        for (v, from, to) in [(a, b, c), (b, c, a), (c, a, b)] {
            fans[v as usize].push((from, to));
        }
    }
    for (vertex, fan) in fans.iter().enumerate() {
        let start = fan[0].0;
        let mut at = start;
        for turn in 1.. {
            at = fan.iter().find(|f| f.0 == at).unwrap().1;
            if at == start {
                assert_eq!(turn, fan.len(), "vertex {vertex} has several fans");
                break;
            }
        }
    }
}

#[test]
fn balls_are_filled_to_their_volume_with_the_wanted_count() {
    for target in [500, 2000, 10_000, 40_000] {
        let ball = Ball(1.3);
        let mesh = stuffed(&ball, target);
        assert_eq!(assert_sound(&mesh, &ball, target).euler_characteristic(), 2);
        let volume = 4.0 / 3.0 * std::f64::consts::PI * 1.3_f64.powi(3);
        // The faces are chords of a sphere, so the missing fraction falls with the square of the
        // cell, count^(-2/3).
        let missing = 1.0 - mesh.volume() / volume;
        assert!(missing > 0.0 && missing < 6.0 * (target as f64).powf(-2.0 / 3.0), "{target}: {missing}");
    }
}

#[test]
fn a_torus_keeps_its_hole() {
    let torus = Torus { ring: 1.0, tube: 0.3 };
    let mesh = stuffed(&torus, 12_000);
    assert_eq!(assert_sound(&mesh, &torus, 12_000).euler_characteristic(), 0);
}

#[test]
fn a_cuboid_whose_faces_may_lie_in_the_lattice_is_sound() {
    for (size, target) in [([0.5; 3], 3000), ([1.0, 0.25, 0.5], 8000), ([2.0, 0.2, 0.2], 5000)] {
        let cuboid = Cuboid(size);
        let mesh = stuffed(&cuboid, target);
        assert_eq!(assert_sound(&mesh, &cuboid, target).euler_characteristic(), 2);
    }
}

#[test]
fn foams_with_thin_necks_and_crumbs_stay_manifold() {
    for seed in 0..12 {
        let foam = Foam::new(seed);
        for target in [2500, 15_000] {
            // The test keeps all parts, because the largest part changes with the cell.
            let options = StuffOptions { target_tets: target, parts: Parts::All };
            assert_sound(&stuff(&foam, &options, &mut |_| ()).unwrap(), &foam, target);
        }
    }
}

#[test]
fn the_largest_part_is_kept_unless_all_are_wanted() {
    let pair = Foam(vec![(Vector3::repeat(0.1), 0.25), (Vector3::repeat(0.9), 0.15)]);
    let volume = |r: f64| 4.0 / 3.0 * std::f64::consts::PI * r.powi(3);
    let one = stuffed(&pair, 8000);
    assert!((one.volume() / volume(0.25) - 1.0).abs() < 0.02, "{}", one.volume());
    let all = StuffOptions { target_tets: 8000, parts: Parts::All };
    let all = stuff(&pair, &all, &mut |_| ()).unwrap();
    assert!((all.volume() / (volume(0.25) + volume(0.15)) - 1.0).abs() < 0.02, "{}", all.volume());
}

#[test]
fn the_mesh_does_not_depend_on_the_number_of_threads() {
    let torus = Torus { ring: 1.0, tube: 0.4 };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| stuffed(&torus, 5000))
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn progress_starts_at_0_ends_at_1_and_does_not_go_back() {
    let mut told = Vec::new();
    stuff(&Ball(1.0), &StuffOptions::with_target(3000), &mut |share| told.push(share)).unwrap();
    assert_eq!(told.first(), Some(&0.0));
    assert_eq!(told.last(), Some(&1.0));
    assert!(told.is_sorted());
}

#[test]
fn what_cannot_be_filled_is_refused_by_name() {
    struct Nothing([[f64; 3]; 2]);
    impl SignedDistance for Nothing {
        fn distance(&self, _: [f64; 3]) -> f64 {
            1.0
        }
        fn bounds(&self) -> [[f64; 3]; 2] {
            self.0
        }
    }
    let error = |bounds, target| {
        stuff(&Nothing(bounds), &StuffOptions::with_target(target), &mut |_| ()).unwrap_err()
    };
    let unit = [[0.0; 3], [1.0; 3]];
    assert!(matches!(error(unit, 1000), MeshError::Empty { .. }));
    assert!(matches!(error(unit, 0), MeshError::Parameter { name: "number of tetrahedra", .. }));
    assert!(matches!(error(unit, usize::MAX), MeshError::Parameter { name: "number of tetrahedra", .. }));
    for high in [f64::NAN, f64::INFINITY, 0.0, -1.0] {
        let flat = [[0.0; 3], [1.0, high, 1.0]];
        assert!(matches!(error(flat, 1000), MeshError::Parameter { name: "box around the shape", .. }));
    }
    let too_few = stuff(&Torus { ring: 1.0, tube: 0.1 }, &StuffOptions::with_target(1), &mut |_| ());
    assert!(matches!(too_few, Err(MeshError::TetCount { wanted: 1, .. })), "{too_few:?}");
}

/// Returns the surface of a unit cube of these cells whose points are moved.
fn moved_cube(cells: [usize; 3], to: impl Fn([f64; 3]) -> [f64; 3]) -> Surface {
    let mut cube = shapes::bar(cells, [1.0; 3]).unwrap();
    cube.nodes.iter_mut().for_each(|p| *p = to(*p));
    cube.boundary().0
}

/// Returns a flat blade, 1 m x 0.2 m.
fn blade(thickness: f64) -> Surface {
    moved_cube([50, 10, 2], |[x, y, z]| [x, 0.2 * y, thickness * z])
}

/// Returns a surface that is turned against the lattice.
fn turned(mut surface: Surface) -> Surface {
    let turn = Rotation3::from_euler_angles(0.4, 0.5, 0.6);
    surface.positions.iter_mut().for_each(|p| *p = (turn * Vector3::from(*p)).into());
    surface
}

/// Returns a blade that is bent around its width and whose thickness falls from 30 to 6 mm.
fn saber() -> Surface {
    moved_cube([60, 12, 2], |[x, y, z]| {
        let radius = 1.0 / 1.2 + (0.03 - 0.024 * y) * (z - 0.5);
        [radius * (1.2 * x).sin(), 0.2 * y, radius * (1.2 * x).cos()]
    })
}

/// Returns a cup of radius 0.1 m and height 0.2 m with walls of this thickness.
fn cup(wall: f64) -> Surface {
    const ROUND: u32 = 96;
    let (radius, height) = (0.1, 0.2);
    let share = |n: i32, of: i32| f64::from(n) / f64::from(of);
    let mut profile: Vec<[f64; 2]> = (1..=16).map(|n| [radius * share(n, 16), 0.0]).collect();
    profile.extend((1..=24).map(|n| [radius, height * share(n, 24)]));
    profile.extend((0..=24).rev().map(|n| [radius - wall, wall + (height - wall) * share(n, 24)]));
    profile.extend((1..16).rev().map(|n| [(radius - wall) * share(n, 16), wall]));
    let mut cup = Surface { positions: vec![[0.0; 3], [0.0, wall, 0.0]], ..Surface::default() };
    for [r, y] in &profile {
        cup.positions.extend((0..ROUND).map(|k| {
            let angle = std::f64::consts::TAU * f64::from(k) / f64::from(ROUND);
            [r * angle.cos(), *y, r * angle.sin()]
        }));
    }
    let vertex = |ring: u32, k: u32| 2 + ring * ROUND + k % ROUND;
    let last = profile.len() as u32 - 1;
    for k in 0..ROUND {
        cup.triangles
            .extend([[0, vertex(0, k), vertex(0, k + 1)], [vertex(last, k), 1, vertex(last, k + 1)]]);
        for ring in 0..last {
            let [a, b] = [vertex(ring, k), vertex(ring, k + 1)];
            let [c, d] = [vertex(ring + 1, k), vertex(ring + 1, k + 1)];
            cup.triangles.extend([[a, c, d], [a, d, b]]);
        }
    }
    cup.closed().unwrap()
}

/// Returns the volume between the boundary of a mesh and the surface, m^3: the distance of each
/// triangle's center times its area.
fn gap(boundary: &Surface, sdf: &dyn SignedDistance) -> f64 {
    let of = |[a, b, c]: [Vector3<f64>; 3]| {
        sdf.distance(((a + b + c) / 3.0).into()).abs() * 0.5 * (b - a).cross(&(c - a)).norm()
    };
    boundary.corners().map(of).sum()
}

/// Returns a ball of radius 0.1 m with a wall of this thickness around its cavity.
fn hollow_ball(wall: f64) -> Surface {
    let ball = |radius| shapes::sphere(10, radius).unwrap().boundary().0;
    let (mut outer, inner) = (ball(0.1), ball(0.1 - wall));
    let offset = outer.positions.len() as u32;
    outer.positions.extend(inner.positions);
    outer.triangles.extend(inner.triangles.iter().map(|[a, b, c]| [a + offset, c + offset, b + offset]));
    outer
}

/// Fills a thin surface and checks what `stuff` promises for it.
fn filled_thin(name: &str, surface: &Surface, target: usize) -> TetMesh {
    let sdf = SurfaceDistance::new(surface).unwrap();
    let start = std::time::Instant::now();
    let mesh = stuffed(&sdf, target);
    let seconds = start.elapsed().as_secs_f64();
    let lost = 1.0 - mesh.volume() / surface.volume();
    let quality = mesh.quality();
    // The rows of docs/report/measurements.md.
    println!(
        "{name}: lost {:.2} %, between {:.1} %, {:.1} to {:.1} degrees, {seconds:.1} s",
        100.0 * lost,
        100.0 * gap(&mesh.boundary().0, &sdf) / surface.volume(),
        quality.min_dihedral_deg,
        quality.max_dihedral_deg,
    );
    assert!(lost.abs() <= VOLUME_TOLERANCE, "{name} loses {:.1} % of its volume", 100.0 * lost);
    let count = mesh.tets.len();
    assert!(count.abs_diff(target) as f64 <= COUNT_TOLERANCE * target as f64, "{name}: {count}");
    let (boundary, _) = mesh.boundary();
    boundary.check_edges().unwrap();
    let parts = surface.part_count();
    assert_eq!(boundary.part_count(), parts, "{name}");
    assert_eq!(boundary.euler_characteristic(), 2 * parts as i64, "{name} has holes");
    assert!(quality.min_dihedral_deg >= FITTED_BOUNDS_DEG[0] - 1e-9, "{name}: {quality:?}");
    assert!(quality.max_dihedral_deg <= FITTED_BOUNDS_DEG[1] + 1e-9, "{name}: {quality:?}");
    mesh
}

#[test]
fn thin_parts_keep_their_volume_in_one_piece() {
    for thickness in [0.04, 0.02, 0.01, 0.005] {
        filled_thin(&format!("blade of {thickness} m"), &blade(thickness), 8000);
    }
    filled_thin("turned blade of 0.02 m", &turned(blade(0.02)), 8000);
    filled_thin("saber", &saber(), 8000);
    filled_thin("cup of 8 mm", &cup(0.008), 8000);
    filled_thin("hollow ball of 8 mm", &hollow_ball(0.008), 8000);
}

#[test]
fn the_boundary_of_a_fitted_mesh_is_the_surface() {
    for (name, surface, bound) in
        [("blade", blade(0.02), 0.02), ("saber", saber(), 0.05), ("cup", cup(0.008), 0.05)]
    {
        let sdf = SurfaceDistance::new(&surface).unwrap();
        let (boundary, _) = filled_thin(name, &surface, 8000).boundary();
        let between = gap(&boundary, &sdf);
        assert!(between < bound * surface.volume(), "{name}: {}", between / surface.volume());
    }
}

#[test]
fn fitting_does_not_depend_on_the_number_of_threads() {
    let sdf = SurfaceDistance::new(&saber()).unwrap();
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| stuffed(&sdf, 2000))
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn what_is_far_too_thin_for_its_tetrahedra_is_refused_with_its_loss() {
    let sdf = SurfaceDistance::new(&blade(1e-4)).unwrap();
    let refused = stuff(&sdf, &StuffOptions::with_target(1000), &mut |_| ());
    let Err(MeshError::TooThin { tets: 1000, error }) = refused else { panic!("{refused:?}") };
    assert!(error > VOLUME_TOLERANCE);
}
