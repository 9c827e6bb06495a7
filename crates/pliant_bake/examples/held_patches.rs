//! Compares the force and the surface of pulled patches with full nonlinear solutions, with the
//! time in which a patch's own shapes are made and the time of a step.
//!
//! The full solutions take minutes. They and the model are kept in the folder and read again.
//!
//! `cargo run --release -p pliant_bake --example held_patches -- SURFACE.obj ANCHOR TETS FOLDER
//! [PART_OF_A_CASE]`

use std::{
    collections::BTreeMap,
    error::Error,
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
    time::Instant,
};

use nalgebra::{DMatrix, Vector3};
use pliant_bake::{BakeConfig, Material, PrescribedPatch, StaticLoads, bake, deflect};
use pliant_mesh::{StuffOptions, TetMesh, io, shapes};
use pliant_modal::{Body, BodyConfig, Elasticity, GrabConfig, ModalModel, Patch, StepSettings, SurfaceMesh};

/// A patch and its way.
type Hand = (Patch, Vector3<f64>);

/// Returns the vertex that is farthest in a direction among those near a line along it.
fn farthest(surface: &SurfaceMesh, direction: Vector3<f64>, line: Option<Vector3<f64>>) -> u32 {
    let positions = surface.positions();
    let at = |v: u32| Vector3::from(positions[v as usize].map(f64::from));
    let [low, high] = surface.bounds();
    let size = (0..3).map(|k| f64::from(high[k] - low[k])).fold(0.0, f64::max);
    let near = |v: &u32| line.is_none_or(|to| (at(*v) - to).cross(&direction).norm() < 0.04 * size);
    let count = positions.len() as u32;
    let far = |v: u32| at(v).dot(&direction);
    (0..count).filter(near).max_by(|&a, &b| far(a).total_cmp(&far(b))).unwrap_or(0)
}

/// Returns the mean direction outward of a patch.
fn outward(surface: &SurfaceMesh, patch: &Patch) -> Vector3<f64> {
    let at = |v: u32| Vector3::from(surface.positions()[v as usize].map(f64::from));
    let weight: BTreeMap<u32, f64> = patch.entries().iter().copied().collect();
    let mut out = Vector3::zeros();
    for triangle in surface.triangles() {
        let [a, b, c] = triangle.map(at);
        let share: f64 = triangle.iter().filter_map(|v| weight.get(v)).sum();
        out += share * (b - a).cross(&(c - a));
    }
    out.normalize()
}

/// A case: its name, its hands, and the errors of force and surface that are asked, in percent of
/// the largest force and of the body's size.
struct Case {
    name: String,
    hands: Vec<Hand>,
    asked: [f64; 2],
}

/// Hands on the surface of a mesh.
fn on_surface(model: &ModalModel) -> Result<Vec<Case>, Box<dyn Error>> {
    let (surface, size) = (model.surface(), model.size());
    let [low, high] = surface.bounds();
    let inside = |x: f64| f64::from(low[0]) + x * f64::from(high[0] - low[0]);
    let [x, y] = [Vector3::x(), Vector3::y()];
    let middle = Vector3::new(inside(0.7), 0.0, 0.0);
    let places = [
        ("ear", farthest(surface, y, None), vec![0.03, 0.15]),
        ("far end", farthest(surface, x, None), vec![0.08]),
        ("back", farthest(surface, y, Some(middle)), vec![0.1]),
    ];
    let mut out = Vec::new();
    for (place, vertex, radii) in places {
        for radius in radii {
            let patch = Patch::around(surface, vertex, radius * size)?;
            let normal = outward(surface, &patch);
            let across = normal.cross(&Vector3::z()).normalize();
            for (way, asked) in [(0.08, [4.0, 0.4]), (0.16, [10.0, 0.8])] {
                for (name, direction) in [("out", normal), ("sideways", across), ("in", -normal)] {
                    let name = format!("{place} r {radius} {name} {way}");
                    out.push(Case { name, hands: vec![(patch.clone(), way * size * direction)], asked });
                }
            }
        }
    }
    // Two hands 0.2 of the size apart on the back.
    let apart = [0.6, 0.8].map(|x| farthest(surface, y, Some(Vector3::new(inside(x), 0.0, 0.0))));
    let [a, b] = apart.map(|vertex| Patch::around(surface, vertex, 0.06 * size));
    let (a, b) = (a?, b?);
    for (name, direction) in [("apart", x), ("shear", Vector3::z())] {
        let way = 0.08 * size * direction;
        let hands = vec![(a.clone(), -way), (b.clone(), way)];
        out.push(Case { name: format!("two hands {name} 0.08"), hands, asked: [5.0, 0.5] });
    }
    Ok(out)
}

/// Hands on a bar of 1 m by 0.1 m by 0.1 m along x, which is clamped at x = 0.
fn on_bar(model: &ModalModel) -> Result<Vec<Case>, Box<dyn Error>> {
    let around = |at: [f64; 3], radius| Patch::around(model.surface(), nearest(model, at), radius);
    let diagonal = Vector3::new(0.0, 0.5f64.sqrt(), 0.5f64.sqrt());
    let end = around([1.0, 0.05, 0.05], 0.08)?;
    let corner = around([1.0, 0.1, 0.1], 0.05)?;
    let side = around([0.5, 0.1, 0.05], 0.05)?;
    let y = Vector3::y();
    let mut out = Vec::new();
    let rows = [
        ("tip sideways", &end, y, vec![(0.08, [1.0, 0.1]), (0.3, [2.0, 0.2]), (0.5, [3.0, 0.4])]),
        ("corner of the end", &corner, diagonal, vec![(0.08, [2.0, 0.2]), (0.28, [3.0, 0.3])]),
        ("side of the middle", &side, y, vec![(0.08, [2.0, 0.2]), (0.28, [3.0, 0.3])]),
    ];
    for (place, patch, direction, ways) in rows {
        for (way, asked) in ways {
            let hands = vec![(patch.clone(), way * direction)];
            out.push(Case { name: format!("bar, {place} {way}"), hands, asked });
        }
    }
    // The corners of the end go around its middle.
    let corners = [[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]];
    for (way, asked) in [(0.015, [5.0, 0.3]), (0.07, [10.0, 0.8])] {
        let mut hands = Vec::new();
        for [y, z] in corners {
            let arm = Vector3::new(0.0, y - 0.05, z - 0.05);
            let around = around([1.0, y, z], 0.03)?;
            hands.push((around, way * Vector3::x().cross(&arm).normalize()));
        }
        out.push(Case { name: format!("bar, four corners twisted {way}"), hands, asked });
    }
    Ok(out)
}

/// A hand on the same bar, clamped at both ends.
fn on_clamped_bar(model: &ModalModel) -> Result<Vec<Case>, Box<dyn Error>> {
    let patch = Patch::around(model.surface(), nearest(model, [0.5, 0.1, 0.05]), 0.08)?;
    let case = |(way, asked): (f64, [f64; 2])| Case {
        name: format!("clamped bar, middle {way}"),
        hands: vec![(patch.clone(), way * Vector3::y())],
        asked,
    };
    Ok([(0.06, [2.0, 0.2]), (0.15, [3.0, 0.3])].map(case).into())
}

/// Returns the surface vertex that is nearest to a point.
fn nearest(model: &ModalModel, at: [f64; 3]) -> u32 {
    let positions = model.surface().positions();
    let away = |v: u32| (Vector3::from(positions[v as usize].map(f64::from)) - Vector3::from(at)).norm();
    (0..positions.len() as u32).min_by(|&a, &b| away(a).total_cmp(&away(b))).unwrap_or(0)
}

/// The forces and the surface of a full solution, kept in a file.
fn full(
    path: &Path,
    mesh: &TetMesh,
    config: &BakeConfig,
    hands: &[Hand],
) -> Result<Vec<[f64; 3]>, Box<dyn Error>> {
    if let Ok(text) = fs::read_to_string(path) {
        let numbers = text.split_whitespace().map(str::parse).collect::<Result<Vec<f64>, _>>()?;
        return Ok(numbers.as_chunks::<3>().0.to_vec());
    }
    let held: Vec<PrescribedPatch> = hands
        .iter()
        .map(|(patch, way)| PrescribedPatch { patch: patch.clone(), displacement: (*way).into() })
        .collect();
    let loads = StaticLoads { prescribed: &held, ..Default::default() };
    let solved = deflect(mesh, config, Material::NeoHookean, &loads)?;
    let out: Vec<[f64; 3]> = solved.reactions.into_iter().chain(solved.surface).collect();
    let mut text = String::new();
    for [x, y, z] in &out {
        writeln!(text, "{x:e} {y:e} {z:e}")?;
    }
    fs::write(path, text)?;
    Ok(out)
}

/// Time that this thread has run, s, where the system tells it, so that other programs on the
/// machine do not count. Otherwise the time since `begun`.
fn ran(begun: Instant) -> f64 {
    let told = fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanoseconds = told.and_then(|text| text.split_whitespace().next()?.parse::<f64>().ok());
    nanoseconds.map_or_else(|| begun.elapsed().as_secs_f64(), |ns| 1e-9 * ns)
}

/// Time of a fixed piece of work, us: a product of two matrices of 128 rows.
fn yardstick() -> f64 {
    let a = DMatrix::from_fn(128, 128, |i, j| ((i * 31 + j * 17) % 97) as f64);
    let mut times: Vec<f64> = (0..50)
        .map(|_| {
            let begun = Instant::now();
            std::hint::black_box(&a * std::hint::black_box(&a));
            begun.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

/// Prints the rows of one body's cases, those whose names contain `part`.
fn rows(
    mesh: &TetMesh,
    anchors: &[&str],
    cases: fn(&ModalModel) -> Result<Vec<Case>, Box<dyn Error>>,
    (folder, file, part): (&Path, &str, &str),
) -> Result<(), Box<dyn Error>> {
    let begun = Instant::now();
    let anchors = anchors.iter().map(|anchor| anchor.parse()).collect::<Result<_, _>>()?;
    let config = BakeConfig {
        modes: BakeConfig::COORDINATES,
        material: Some(Material::NeoHookean),
        anchors,
        ..BakeConfig::default()
    };
    let file = folder.join(file);
    if !file.exists() {
        fs::write(&file, bake(mesh, None, &config, &mut |_, _| ())?.model.to_bytes())?;
    }
    let model = Arc::new(ModalModel::read(&file)?);
    let (rest, size) = (model.surface().positions(), model.size());
    for Case { name, hands, asked } in cases(&model)? {
        if !name.contains(part) {
            continue;
        }
        let solved = match full(&folder.join(name.replace(' ', "_") + ".txt"), mesh, &config, &hands) {
            Ok(solved) => solved,
            Err(error) => {
                println!("{name:<34} no full solution: {error}");
                continue;
            }
        };
        let (reactions, displacements) = solved.split_at(hands.len());
        let settings =
            StepSettings { elasticity: Elasticity::Reduced, damping_scale: 30.0, ..Default::default() };
        let mut body = Body::new(model.clone(), BodyConfig { step: 1.0 / 60.0, ..settings.into() })?;
        let (mut made, mut count) = (0.0f64, 0);
        let mut grabs = Vec::new();
        for (patch, way) in &hands {
            let grab = body.grab(patch, GrabConfig::default())?;
            grabs.push((grab, Vector3::from(body.target(grab).unwrap_or_default()), way));
        }
        let mut times = Vec::new();
        for i in 1..=1_200 {
            let start = ran(begun);
            if body.make_held_shapes()? {
                made = made.max(1e3 * (ran(begun) - start));
                count += 1;
                times.clear();
            }
            let share = (f64::from(i) / 600.0).min(1.0);
            for &(grab, start, way) in &grabs {
                body.set_target(grab, (start + share * way).into())?;
            }
            let begun = Instant::now();
            body.step()?;
            if i <= 600 || times.len() < 300 {
                times.push(begun.elapsed().as_secs_f64() * 1e6);
            }
        }
        times.sort_by(f64::total_cmp);
        let step = times[times.len() / 2];
        let shapes = body.held_shapes().map(|shapes| [shapes.columns(), shapes.points()]);
        let counts = shapes.unwrap_or_default();
        let largest = reactions.iter().map(|&f| Vector3::from(f).norm()).fold(0.0, f64::max);
        let mut force = 0.0f64;
        for ((grab, ..), want) in grabs.iter().zip(reactions) {
            force = force.max((Vector3::from(body.reaction(*grab)?) - Vector3::from(*want)).norm());
        }
        let mut surface = rest.to_vec();
        body.reconstruct(&mut surface)?;
        let off = |v: usize| {
            let moved = Vector3::from_fn(|k, _| f64::from(surface[v][k]) - f64::from(rest[v][k]));
            (moved - Vector3::from(displacements[v])).norm()
        };
        let dent = (0..rest.len()).map(off).fold(0.0, f64::max);
        let got = [100.0 * force / largest, 100.0 * dent / size];
        let met = [0, 1].map(|k| if got[k] <= asked[k] { "met" } else { "not" });
        println!(
            "{name:<34} {:6.2} {:5.1} {} {:6.2} {:4.1} {} {made:6.0} {count:2} {:3} {:4} {step:5.0} {:6.2}",
            got[0],
            asked[0],
            met[0],
            got[1],
            asked[1],
            met[1],
            counts[0],
            counts[1],
            step / yardstick()
        );
    }
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [surface, anchor, tets, folder, more @ ..] = &arguments[..] else {
        return Err("SURFACE.obj ANCHOR TETS FOLDER [PART_OF_A_CASE] are needed".into());
    };
    let part = more.first().map_or("", String::as_str);
    let folder = PathBuf::from(folder);
    fs::create_dir_all(&folder)?;
    println!(
        "case: force off, asked (%), surface off, asked (%), shapes made in ms at most, how \
         often, columns, points, step in us (50 %), the same over the time of a fixed piece of work"
    );
    let bar = shapes::bar([20, 2, 2], [1.0, 0.1, 0.1])?;
    rows(&bar, &["x<1e-9"], on_bar, (&folder, "bar.modal", part))?;
    rows(&bar, &["x<1e-9", "x>0.999"], on_clamped_bar, (&folder, "clamped.modal", part))?;
    let options = StuffOptions::with_target(tets.parse()?);
    let (mesh, _) = io::read(surface)?.into_tets(&options, &mut |_| ())?;
    println!("{} tetrahedra of {surface}", mesh.tets.len());
    rows(&mesh, &[anchor.as_str()], on_surface, (&folder, "model.modal", part))
}
