#[path = "../tests/uniaxial/mod.rs"]
mod uniaxial;

use pliant_mesh::shapes;
use pliant_modal::SurfaceMesh;
use uniaxial::uniaxial;

use super::*;

const LAWS: [Material; 2] = [Material::NeoHookean, Material::StVenantKirchhoff];

fn left_end() -> Vec<crate::Anchor> {
    vec!["x<1e-9".parse().unwrap()]
}

/// The surface of a mesh as the solver numbers it.
fn surface(mesh: &TetMesh) -> SurfaceMesh {
    let (surface, _) = mesh.boundary();
    let positions = surface.positions.iter().map(|p| p.map(|x| x as f32)).collect::<Vec<_>>();
    let count = positions.len();
    SurfaceMesh::new(positions, surface.triangles, None, vec![false; count]).unwrap()
}

/// Returns the vertices that `keep` accepts.
fn vertices(surface: &SurfaceMesh, keep: impl Fn(&[f32; 3]) -> bool) -> Vec<u32> {
    (0..surface.positions().len() as u32).filter(|&v| keep(&surface.positions()[v as usize])).collect()
}

/// Makes a force that is spread over these vertices in equal parts.
fn spread(surface: &SurfaceMesh, on: &[u32], force: [f64; 3]) -> Vec<DeadLoad> {
    let share = force.map(|f| f / on.len() as f64);
    on.iter().map(|&v| DeadLoad { patch: Patch::around(surface, v, 0.0).unwrap(), force: share }).collect()
}

fn under<'a>(forces: &'a [DeadLoad]) -> StaticLoads<'a> {
    StaticLoads { forces, ..Default::default() }
}

/// Solves a slender cantilever under a dead load `p` = P L^2 / (E I) across its end.
///
/// The cantilever is 1 m long and a thirtieth of that thick, with nu = 0.
fn cantilever(material: Material, p: f64) -> [f64; 3] {
    let thick = 1.0 / 30.0;
    let mesh = shapes::bar([30, 1, 1], [1.0, thick, thick]).unwrap();
    let config = BakeConfig { young: 1e6, poisson: 0.0, anchors: left_end(), ..BakeConfig::default() };
    let surface = surface(&mesh);
    let stiffness = 1e6 * thick.powi(4) / 12.0;
    let end = vertices(&surface, |p| p[0] > 0.999);
    let loads = spread(&surface, &end, [0.0, p * stiffness, 0.0]);
    let solved = deflect(&mesh, &config, material, &under(&loads)).unwrap();
    let count = solved.patches.len() as f64;
    std::array::from_fn(|k| solved.patches.iter().map(|p| p[k]).sum::<f64>() / count)
}

#[test]
fn a_slender_cantilever_bends_as_the_elastica() {
    // The values are v / L and u / L of the elastica (Bisshopp and Drucker 1945). A bar of
    // aspect ratio 30 also shears, by 3 E I / (k G A L^2) ~ 0.3 % of v.
    for material in LAWS {
        for (p, v, u) in [(1.0, 0.30172, 0.05643), (2.0, 0.49346, 0.16064)] {
            let tip = cantilever(material, p);
            println!("{material:?}, P L^2 / E I = {p}: {tip:.5?}, the elastica {u} {v}");
            assert!((tip[1] / v - 1.0).abs() < 0.01, "{material:?} P L^2 / E I = {p}: {tip:?}");
            assert!((-tip[0] / u - 1.0).abs() < 0.02, "{material:?} P L^2 / E I = {p}: {tip:?}");
        }
    }
}

#[test]
fn a_stretched_bar_pulls_as_its_law_says() {
    let (young, poisson, thick) = (1e5, 0.4, 0.1);
    let mesh = shapes::bar([20, 2, 2], [1.0, thick, thick]).unwrap();
    let config = BakeConfig { young, poisson, anchors: left_end(), ..BakeConfig::default() };
    let surface = surface(&mesh);
    let end = vertices(&surface, |p| p[0] > 0.999);
    for stretch in [1.1, 1.3] {
        for material in LAWS {
            let stress = match material {
                Material::NeoHookean => uniaxial(young, poisson, stretch),
                _ => 0.5 * young * stretch * (stretch * stretch - 1.0),
            };
            let loads = spread(&surface, &end, [stress * thick * thick, 0.0, 0.0]);
            let solved = deflect(&mesh, &config, material, &under(&loads)).unwrap();
            // The middle half does not feel how the ends are held.
            let at = |x: f32| {
                let on = vertices(&surface, |p| (p[0] - x).abs() < 1e-3);
                on.iter().map(|&v| solved.surface[v as usize][0]).sum::<f64>() / on.len() as f64
            };
            let got = 1.0 + (at(0.75) - at(0.25)) / 0.5;
            println!("{material:?}: {got:.5}, the closed form {stretch}");
            assert!((got - stretch).abs() < 2e-3 * (stretch - 1.0), "{material:?}: {got} and {stretch}");
        }
    }
}

#[test]
fn a_bar_hangs_under_its_weight() {
    let (young, density, g) = (1e6, 1000.0, 9.81);
    let mesh = shapes::bar([10, 2, 2], [1.0, 0.2, 0.2]).unwrap();
    let anchors = left_end();
    let config = BakeConfig { young, density, poisson: 0.0, anchors, ..BakeConfig::default() };
    let surface = surface(&mesh);
    let end = vertices(&surface, |p| p[0] > 0.999);
    let loads = StaticLoads { gravity: [g, 0.0, 0.0], ..Default::default() };
    let solved = deflect(&mesh, &config, Material::NeoHookean, &loads).unwrap();
    // rho g L^2 / (2 E) for small strains; here the strain is half a percent.
    let small = density * g / (2.0 * young);
    for &vertex in &end {
        assert!((solved.linear[vertex as usize][0] / small - 1.0).abs() < 1e-6);
        assert!((solved.surface[vertex as usize][0] / small - 1.0).abs() < 0.01);
    }
}

#[test]
fn a_patch_that_is_led_to_where_a_force_brought_it_feels_that_force() {
    let mesh = shapes::bar([10, 2, 2], [1.0, 0.1, 0.1]).unwrap();
    let config = BakeConfig { anchors: left_end(), ..BakeConfig::default() };
    let surface = surface(&mesh);
    let corner = vertices(&surface, |p| p[0] > 0.999 && p[1] > 0.099 && p[2] > 0.099)[0];
    let patch = Patch::around(&surface, corner, 0.06).unwrap();
    for material in LAWS {
        let force = [0.08, 0.64, -0.32];
        let dead = [DeadLoad { patch: patch.clone(), force }];
        let pulled = deflect(&mesh, &config, material, &under(&dead)).unwrap();
        let displacement = pulled.patches[0];
        let prescribed = [PrescribedPatch { patch: patch.clone(), displacement }];
        let loads = StaticLoads { prescribed: &prescribed, ..Default::default() };
        let held = deflect(&mesh, &config, material, &loads).unwrap();
        let reach = displacement.iter().map(|x| x * x).sum::<f64>().sqrt();
        assert!(reach > 0.2, "{displacement:?}");
        for (reaction, force) in held.reactions[0].iter().zip(&force) {
            assert!((reaction + force).abs() < 1e-6 * 0.72, "{:?}", held.reactions);
        }
        for (a, b) in pulled.surface.iter().flatten().zip(held.surface.iter().flatten()) {
            assert!((a - b).abs() < 1e-6 * reach, "{a} and {b}");
        }
        assert!(held.residual > 0.0 && held.residual <= 1e-8);
        // Castigliano: the energy grows by the force along the way.
        let further = displacement.map(|x| 1.001 * x);
        let prescribed = [PrescribedPatch { patch: patch.clone(), displacement: further }];
        let loads = StaticLoads { prescribed: &prescribed, ..Default::default() };
        let more = deflect(&mesh, &config, material, &loads).unwrap();
        let work: f64 =
            (0..3).map(|k| 0.5 * (force[k] - more.reactions[0][k]) * (further[k] - displacement[k])).sum();
        assert!(((more.energy - held.energy) / work - 1.0).abs() < 1e-3);
    }
}

#[test]
fn a_block_is_pressed_to_half_its_height() {
    let mesh = shapes::bar([4, 4, 4], [1.0, 1.0, 1.0]).unwrap();
    // All nodes of the top are corners of four-node elements, so the top stays flat.
    let element = pliant_modal::Element::Tet4;
    let config = BakeConfig { element, anchors: left_end(), ..BakeConfig::default() };
    let surface = surface(&mesh);
    let top = vertices(&surface, |p| p[0] > 0.999);
    let press = |by: f64, material: Material| {
        let prescribed: Vec<PrescribedPatch> = top
            .iter()
            .map(|&v| PrescribedPatch {
                patch: Patch::around(&surface, v, 0.0).unwrap(),
                displacement: [-by, 0.0, 0.0],
            })
            .collect();
        deflect(&mesh, &config, material, &StaticLoads { prescribed: &prescribed, ..Default::default() })
    };
    let mut last = 0.0;
    for by in [0.1, 0.3, 0.5] {
        let force: f64 = press(by, Material::NeoHookean).unwrap().reactions.iter().map(|f| f[0]).sum();
        println!("pressed by {by}: {force:.1} N");
        assert!(force > last, "pressed by {by}: {force} N after {last} N");
        last = force;
    }
}

#[test]
fn a_small_load_gives_the_linear_solution() {
    let mesh = shapes::bar([4, 1, 1], [1.0, 0.25, 0.25]).unwrap();
    let config = BakeConfig { anchors: left_end(), ..BakeConfig::default() };
    let surface = surface(&mesh);
    let patch = Patch::around(&surface, surface.positions().len() as u32 - 1, 0.0).unwrap();
    for material in LAWS {
        let dead = [DeadLoad { patch: patch.clone(), force: [0.0, 1e-4, 2e-4] }];
        let solved = deflect(&mesh, &config, material, &under(&dead)).unwrap();
        assert!(solved.residual > 0.0 && solved.residual <= 1e-8, "{}", solved.residual);
        let largest = solved.linear.iter().flatten().fold(0.0f64, |m, x| m.max(x.abs()));
        for (a, b) in solved.surface.iter().flatten().zip(solved.linear.iter().flatten()) {
            assert!((a - b).abs() < 1e-4 * largest, "{a} and {b}");
        }
        let prescribed = [PrescribedPatch { patch: patch.clone(), displacement: [0.0, 1e-6, 0.0] }];
        let loads = StaticLoads { prescribed: &prescribed, ..Default::default() };
        let held = deflect(&mesh, &config, material, &loads).unwrap();
        for (a, b) in held.reactions[0].iter().zip(&held.linear_reactions[0]) {
            assert!((a - b).abs() < 1e-4 * held.linear_reactions[0][1].abs(), "{a} and {b}");
        }
    }
}

#[test]
fn what_it_cannot_solve_is_refused() {
    let mesh = shapes::bar([2, 1, 1], [1.0, 0.5, 0.5]).unwrap();
    let (free, none) = (BakeConfig::default(), StaticLoads::default());
    assert!(matches!(
        deflect(&mesh, &free, Material::default(), &none),
        Err(BakeError::Parameter { name: "anchors", .. })
    ));
    let held = BakeConfig { poisson: 0.49, anchors: vec!["x<1e-9".parse().unwrap()], ..free };
    assert!(matches!(
        deflect(&mesh, &held, Material::default(), &none),
        Err(BakeError::Parameter { name: "Poisson ratio", .. })
    ));
}
