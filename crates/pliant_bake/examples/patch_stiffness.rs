//! Compares the static stiffness under a hand at a patch with the full finite-element solution.
//!
//! The example prints the distribution over patches around every surface vertex, at radii between
//! the baked ones, and the errors of a few named patches.
//!
//! `cargo run --release -p pliant_bake --example patch_stiffness --
//! bar | TETRAHEDRA.msh ANCHOR [tet4|tet10] [MODES]`

use std::{error::Error, time::Instant};

use nalgebra::Matrix3;
use pliant_bake::{BakeConfig, bake};
use pliant_mesh::{TetMesh, io, shapes};
use pliant_modal::{Element, ModalModel, Patch};

/// Returns `W^T Phi Lambda^-1 Phi^T W` of a patch, m/N.
fn modal_compliance(model: &ModalModel, patch: &Patch) -> Matrix3<f64> {
    let mut out = Matrix3::zeros();
    for (mode, omega) in model.omega().iter().enumerate() {
        let mut phi = nalgebra::Vector3::zeros();
        for &(vertex, weight) in patch.entries() {
            for axis in 0..3 {
                phi[axis] += weight * f64::from(model.displacement_row(vertex, axis, mode));
            }
        }
        out += phi * phi.transpose() / (omega * omega);
    }
    out
}

fn square(m: [[f64; 3]; 3]) -> Matrix3<f64> {
    Matrix3::from_fn(|i, j| m[i][j])
}

/// Returns three named vertices.
///
/// They are the center of the end in +x (a bar's tip: axial along x, bending along y and z), a
/// vertex near the root, and the highest vertex (a bunny's ear).
fn named(model: &ModalModel) -> [(&'static str, u32); 3] {
    let positions = model.surface().positions();
    let [low, high] = model.surface().bounds();
    let nearest = |goal: [f32; 3]| {
        let away = |v: u32| (0..3).map(|k| (positions[v as usize][k] - goal[k]).powi(2)).sum::<f32>();
        (0..positions.len() as u32).min_by(|&a, &b| away(a).total_cmp(&away(b))).unwrap_or(0)
    };
    let middle = [0, 1, 2].map(|k| 0.5 * (low[k] + high[k]));
    let top = positions.iter().copied().max_by(|a, b| a[1].total_cmp(&b[1])).unwrap_or(high);
    [
        ("tip in x", nearest([high[0], middle[1], middle[2]])),
        ("near the root", nearest([low[0] + 0.15 * (high[0] - low[0]), high[1], middle[2]])),
        ("highest, an ear", nearest(top)),
    ]
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let argument = |k: usize| arguments.get(k).map(String::as_str);
    let (mesh, anchor): (TetMesh, &str) = match argument(0) {
        None | Some("bar") => (shapes::bar([40, 6, 6], [1.0, 0.15, 0.15])?, "x<0.001"),
        Some(path) => (io::read_tets(path)?, argument(1).ok_or("which nodes are held? such as 'x<0.01'")?),
    };
    let element = if argument(2) == Some("tet4") { Element::Tet4 } else { Element::Tet10 };
    let modes = argument(3).map_or(Ok(60), str::parse)?;
    let config = BakeConfig { element, modes, anchors: vec![anchor.parse()?], ..BakeConfig::linear() };
    let begun = Instant::now();
    let made = bake(&mesh, None, &config, &mut |_, _| ())?;
    let model = made.model;
    println!(
        "{} tetrahedra, {} surface vertices, {} modes, {} sites, {:?}, {:.2} s",
        mesh.tets.len(),
        model.surface().positions().len(),
        modes,
        model.parts().sites.len(),
        made.times,
        begun.elapsed().as_secs_f64()
    );
    println!("   radius   modes alone: median, 90 %, worst    felt: median, 90 %, 99 %, worst, within 2 %");
    for share in [0.033, 0.047, 0.067, 0.095, 0.135] {
        let every = BakeConfig { sites: Some(usize::MAX), site_radii: vec![share], ..config.clone() };
        let exact = bake(&mesh, None, &every, &mut |_, _| ())?.model;
        let by_name = named(&model);
        let mut told = String::new();
        let (mut alone, mut felt, mut worst) = (Vec::new(), Vec::new(), (0.0, 0, 0));
        for site in &exact.parts().sites {
            let patch = Patch::around(model.surface(), site.vertex, site.radius)?;
            let modal = modal_compliance(&exact, &patch);
            let truth = modal + square(site.flexibility);
            let got = modal_compliance(&model, &patch) + square(model.residual_flexibility(&patch, modes)?);
            for (name, _) in by_name.iter().filter(|(_, vertex)| *vertex == site.vertex) {
                let off = |axis: usize| 100.0 * (got[(axis, axis)] / truth[(axis, axis)] - 1.0);
                told +=
                    &format!("            {name}: x {:+.2}, y {:+.2}, z {:+.2} %\n", off(0), off(1), off(2));
            }
            for axis in 0..3 {
                let e = (got[(axis, axis)] / truth[(axis, axis)] - 1.0).abs();
                if e > worst.0 {
                    worst = (e, site.vertex, axis);
                }
                felt.push(e);
                alone.push((modal[(axis, axis)] / truth[(axis, axis)] - 1.0).abs());
            }
        }
        alone.sort_by(f64::total_cmp);
        felt.sort_by(f64::total_cmp);
        let at = |list: &[f64], part: f64| 100.0 * list[((list.len() - 1) as f64 * part) as usize];
        let within = felt.iter().filter(|e| **e <= 0.02).count() as f64 / felt.len() as f64;
        println!(
            "   {share:>6.3}   {:>6.2} {:>6.2} {:>6.2} %   {:>6.3} {:>6.2} {:>6.2} {:>6.2} %   {:.1} %   worst at {:?}, axis {}",
            at(&alone, 0.5),
            at(&alone, 0.9),
            at(&alone, 1.0),
            at(&felt, 0.5),
            at(&felt, 0.9),
            at(&felt, 0.99),
            at(&felt, 1.0),
            100.0 * within,
            model.surface().positions()[worst.1 as usize],
            worst.2
        );
        print!("{told}");
    }
    Ok(())
}
