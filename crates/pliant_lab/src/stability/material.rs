//! Material and mesh of a body: stiffness, Poisson ratio, density, damping, size, element shape and
//! number of modes.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{Body, BodyConfig, Element, GrabConfig, Integrator, ModalModel, StepSettings};

use super::{
    Bound, Case, CaseOutcome, Expected,
    bodies::{BarBody, HeldCase, energy_growth, no_growth, ringing, settling, static_pull},
    plain,
    solid::{Solid, lame},
};
use crate::LabError;

/// Largest allowed excursion of a dragged patch, as a multiple of the drag: a spring without
/// damping that is jerked overshoots by as much as it is led, and no more.
const EXCURSION: f64 = 2.0;

/// Largest allowed difference of a held reaction from the static one, as a share of it. A bar a
/// fifth as thick as long that is bent by a millionth of its length is off by 6e-5 (see [`hold`]).
const STATIC: f64 = 2e-4;

/// The same from full finite elements, as a share: what the baked flexibilities leave out.
const FULL: f64 = 5e-3;

const OFF_FULL: &str = "|reaction - full finite elements| / full finite elements";

const ONE_CELL: &str = "a face of one cell across has vertices on its edges only, forty times as close along them: a patch there is a line, and its flexibility is taken from that of round patches of the same sharpness";

const TOO_THIN: &str = "the bake refuses the mesh by name: the stiffness of its thinnest elements, times the rounding of a double, is more than a ten-millionth of what the slowest modes weigh";

pub(super) fn cases(out: &mut Vec<Case>) {
    for exponent in 2..=12 {
        let young = 10.0_f64.powi(exponent);
        for step in [1e-4, 1.0 / 60.0, 0.1] {
            let name = format!("E 1e{exponent} Pa, h {step:.4} s, tip dragged");
            out.push(Case::new("stiffness", name, move || {
                drag(&BarBody { young, ..BarBody::default() }, BodyConfig { step, ..BodyConfig::default() })
            }));
        }
        let name = format!("E 1e{exponent} Pa, reaction held");
        out.push(Case::new("stiffness", name, move || {
            hold(&BarBody { young, zeta: 0.3, ..BarBody::default() }, 1.0 / 60.0)
        }));
    }
    for integrator in [Integrator::Newmark, Integrator::GeneralizedAlpha { rho_inf: 0.5 }] {
        for young in [1e3, 1e6, 1e12] {
            let name = format!("E {young:.0e} Pa, {}, tip dragged", word(integrator));
            out.push(Case::new("stiffness", name, move || {
                drag(
                    &BarBody { young, ..BarBody::default() },
                    BodyConfig::from(StepSettings { integrator, ..Default::default() }),
                )
            }));
        }
    }
    for element in [Element::Tet4, Element::Tet10] {
        for poisson in [0.0, 0.3, 0.45, 0.49, 0.499, 0.4999] {
            let name = format!("nu {poisson}, {element}, reaction held");
            let bar = BarBody { poisson, element, zeta: 0.3, sites: None, ..BarBody::default() };
            out.push(Case::new("Poisson ratio", name, move || {
                // Above, the bake averages the pressure: see the fine mesh among the full elements.
                hold_mesh(&bar, &bar.mesh()?, 1.0 / 60.0, bar.poisson <= 0.45)
            }));
        }
    }
    for density in [1.0, 10.0, 100.0, 1e3, 2e4] {
        let bar = BarBody { density, ..BarBody::default() };
        out.push(Case::new("density", format!("{density} kg/m^3, tip dragged"), move || {
            drag(&bar, BodyConfig::default())
        }));
    }
    for zeta in [0.0, 1e-3, 0.03, 0.5, 1.0, 2.0, 10.0] {
        for integrator in
            [Integrator::Exact, Integrator::Newmark, Integrator::GeneralizedAlpha { rho_inf: 0.5 }]
        {
            let name = format!("{zeta} of critical, {}, struck", word(integrator));
            let bar = BarBody { zeta, ..BarBody::default() };
            out.push(Case::new("damping", name, move || struck(&bar, 1.0 / 60.0, integrator)));
        }
        if zeta > 0.0 {
            let bar = BarBody { zeta, ..BarBody::default() };
            let name = format!("{zeta} of critical, reaction held");
            out.push(Case::new("damping", name, move || hold(&bar, 1.0 / 60.0)));
        }
    }
    for exponent in -3..=3 {
        let length = 10.0_f64.powi(exponent);
        let bar = BarBody { length, zeta: 0.3, ..BarBody::default() };
        let again = bar.clone();
        out.push(Case::new("size", format!("1e{exponent} m, tip dragged"), move || {
            drag(&again, BodyConfig::default())
        }));
        out.push(Case::new("size", format!("1e{exponent} m, reaction held"), move || hold(&bar, 1.0 / 60.0)));
    }
    for step in [1e-4, 1e-3, 1.0 / 240.0, 1.0 / 40.0, 0.1] {
        let name = format!("h {step:.4} s, struck without damping");
        out.push(Case::new("step", name, move || {
            struck(&BarBody { zeta: 0.0, ..BarBody::default() }, step, Integrator::Exact)
        }));
    }
    for (name, cells, section, refused) in [
        ("needles, edges 10 : 1", [4, 4, 4], [0.1, 0.1], false),
        ("needles, edges 40 : 1", [4, 4, 4], [0.025, 0.025], true),
        ("plates, edges 10 : 1", [4, 4, 1], [1.0, 0.025], false),
        ("plates, edges 50 : 1", [4, 4, 1], [1.0, 0.005], true),
        ("plates across, edges 40 : 1", [40, 1, 1], [1.0, 1.0], false),
    ] {
        let bar = BarBody { cells, section, zeta: 0.3, sites: None, ..BarBody::default() };
        let case = shaped("element shape", format!("{name}, reaction held"), refused, move || {
            bar.mesh().map(|m| (bar.clone(), m))
        });
        // What a mesh is off by is one number, so that the range is narrow.
        out.push(match name {
            "plates across, edges 40 : 1" => {
                case.limited(ONE_CELL, Expected::Measured(&[(OFF_FULL, 0.041, 0.0445)]))
            }
            _ => case,
        });
    }
    for (name, share, refused) in
        [("a hundredth", 0.99, false), ("a thousandth", 0.999, false), ("a millionth", 0.999_999, true)]
    {
        let name = format!("slivers, {name} of the height, reaction held");
        out.push(shaped("element shape", name, refused, move || {
            let bar = BarBody { zeta: 0.3, sites: None, ..BarBody::default() };
            Ok((bar.clone(), slivers(bar.mesh()?, share)))
        }));
    }
    for (ratio, refused) in [(1e3, false), (1e4, false), (1e6, true)] {
        let name = format!("slices of a bar {ratio:.0e} : 1, reaction held");
        out.push(shaped("mass ratio", name, refused, move || {
            let bar = BarBody { zeta: 0.3, sites: None, ..BarBody::default() };
            Ok((bar.clone(), graded(&bar, ratio)?))
        }));
    }
    for (modes, cells) in [(1, [8, 2, 2]), (500, [10, 3, 3])] {
        let bar = BarBody { modes, cells, zeta: 0.1, ..BarBody::default() };
        let [held, dragged, struck_one] = [bar.clone(), bar.clone(), bar];
        out.push(Case::new("modes", format!("{modes}, reaction held"), move || hold(&held, 1.0 / 60.0)));
        out.push(Case::new("modes", format!("{modes}, tip dragged"), move || {
            drag(&dragged, BodyConfig::default())
        }));
        out.push(Case::new("modes", format!("{modes}, struck"), move || {
            struck(&struck_one, 1.0 / 60.0, Integrator::Exact)
        }));
    }
    for (name, bar, mesh) in forms() {
        for step in [1e-3, 1.0 / 60.0] {
            let bar = bar.clone();
            out.push(Case::new("form", format!("{name}, h {step:.4} s, dragged"), move || {
                let config = BodyConfig { step, ..BodyConfig::default() };
                drag_model(&bar, bar.bake_mesh(&mesh(&bar)?)?, config)
            }));
        }
        let bar = BarBody { zeta: 0.0, ..bar };
        out.push(Case::new("form", format!("{name}, struck without damping"), move || {
            struck_model(&bar, bar.bake_mesh(&mesh(&bar)?)?, 1.0 / 60.0, Integrator::Exact)
        }));
    }
}

type Form = (&'static str, BarBody, fn(&BarBody) -> Result<TetMesh, LabError>);

/// Bodies of other proportions and shapes: names and meshes.
fn forms() -> [Form; 8] {
    let bar = BarBody::default;
    [
        ("needles, edges 10 : 1", BarBody { cells: [4, 4, 4], section: [0.1, 0.1], ..bar() }, BarBody::mesh),
        (
            "a plate, edges 10 : 1",
            BarBody { cells: [4, 4, 1], section: [1.0, 0.025], ..bar() },
            BarBody::mesh,
        ),
        (
            "plates across, edges 40 : 1",
            BarBody { cells: [40, 1, 1], section: [1.0, 1.0], ..bar() },
            BarBody::mesh,
        ),
        ("slivers, a thousandth of the height", bar(), |bar| Ok(slivers(bar.mesh()?, 0.999))),
        ("slices 1e4 : 1", bar(), |bar| graded(bar, 1e4)),
        ("a cube", BarBody { cells: [4, 4, 4], section: [1.0, 1.0], ..bar() }, BarBody::mesh),
        ("a ball on a cap", BarBody { section: [1.0, 1.0], held: Some(0.15), ..bar() }, |bar| {
            let mut mesh = shapes::sphere(5, 0.5 * bar.length)?;
            mesh.nodes.iter_mut().flatten().for_each(|x| *x += 0.5 * bar.length);
            Ok(mesh)
        }),
        ("a hook of a quarter of a circle", BarBody { cells: [12, 2, 2], ..bar() }, |bar| {
            let mut mesh = bar.mesh()?;
            for node in &mut mesh.nodes {
                let (sin, cos) = (node[0] / bar.length * std::f64::consts::FRAC_PI_2).sin_cos();
                let radius = bar.length * std::f64::consts::FRAC_2_PI - node[1];
                *node = [radius * sin, bar.length * std::f64::consts::FRAC_2_PI - radius * cos, node[2]];
            }
            Ok(mesh)
        }),
    ]
}

/// A case with a mesh of thin elements. `refused` is true if the elements are so thin that the bake
/// rejects the mesh by name.
fn shaped(
    group: &'static str,
    name: String,
    refused: bool,
    made: impl Fn() -> Result<(BarBody, TetMesh), LabError> + Send + Sync + 'static,
) -> Case {
    let case = Case::new(group, name, move || {
        let (bar, mesh) = made()?;
        hold_mesh(&bar, &mesh, 1.0 / 60.0, true)
    });
    if refused { case.limited(TOO_THIN, Expected::Inaccurate) } else { case }
}

pub(super) fn word(integrator: Integrator) -> &'static str {
    match integrator {
        Integrator::Exact => "exact",
        Integrator::Newmark => "Newmark",
        _ => "generalized-alpha 0.5",
    }
}

/// Drags the tip smoothly by a twentieth of the length within a second (or forty steps), then holds
/// it for as long. The force must not ring. A body far slower than the step is still moving, so its
/// bound is looser.
fn drag(bar: &BarBody, config: BodyConfig) -> Result<CaseOutcome, LabError> {
    drag_model(bar, bar.bake()?, config)
}

/// [`drag`] with the model of another mesh.
fn drag_model(bar: &BarBody, model: Arc<ModalModel>, config: BodyConfig) -> Result<CaseOutcome, LabError> {
    let step = config.step;
    let patch = bar.tip(&model)?;
    let mut held = HeldCase::of(model, patch, config, GrabConfig::default())?;
    let seconds = (40.0 * step).max(1.0);
    let steps = (2.0 * seconds / step) as usize;
    let reach = 0.05 * bar.length;
    let away = move |i: usize| {
        let s = crate::smooth((i + 1) as f64 * step / seconds) * reach;
        [0.2 * s, 0.8 * s, -0.5 * s]
    };
    let mut forces = Vec::with_capacity(steps);
    let mut farthest = 0.0f64;
    for i in 0..steps {
        held.pull(away(i))?;
        held.body.step()?;
        forces.push(held.reaction()?);
        let at = Vector3::from(held.body.grab_position(held.grab)?) - Vector3::from(held.start);
        farthest = farthest.max(at.norm());
    }
    let bound = if held.model.omega()[0] * step > 0.05 { 0.02 } else { 0.05 };
    Ok(CaseOutcome::of(vec![
        Bound::new("ringing of the reaction (4: a flip each step)", ringing(&forces), bound),
        Bound::new("farthest the patch goes / the drag", farthest / reach, EXCURSION),
    ])
    .beside(plain::beside(&held.model, step, &[held.patch], steps, |i| vec![away(i)])?)
    .stepped(&held.body))
}

/// Holds the tip a millionth of the length away until the body is at rest. The reaction must equal
/// the static one. (A bar that bends by `d` also shortens by `d^2 / L`, against its axial
/// stiffness. At a ten-thousandth of the length this is already half a percent.)
fn hold(bar: &BarBody, step: f64) -> Result<CaseOutcome, LabError> {
    hold_mesh(bar, &bar.mesh()?, step, false)
}

/// [`hold`] with a mesh. If `full`, the reaction must also be that of full finite elements of the
/// mesh, which no mode and no baked flexibility enters.
fn hold_mesh(bar: &BarBody, mesh: &TetMesh, step: f64, full: bool) -> Result<CaseOutcome, LabError> {
    let model = bar.bake_mesh(mesh)?;
    let patch = bar.tip(&model)?;
    let config = BodyConfig { step, ..BodyConfig::default() };
    let mut held = HeldCase::of(model, patch, config, GrabConfig::default())?;
    let away = [0.0, 1e-6 * bar.length, 0.5e-6 * bar.length];
    held.pull(away)?;
    for _ in 0..settling(&held.model, step) {
        held.body.step()?;
    }
    let got = -held.reaction()?;
    let off = |want: Vector3<f64>| (got - want).norm() / want.norm();
    // A bar half as thick shortens by four times as much, compared with what it bends.
    let thin = bar.section == [0.1, 0.1];
    let limit = if thin { 4.0 * STATIC } else { STATIC };
    let mut bounds = vec![Bound::new("|reaction - static| / static", off(static_pull(&held, away)?), limit)];
    if full {
        let solid = Solid::new(mesh, bar.element, lame(bar.young, bar.poisson), 1e-9 * bar.length);
        let want = -solid.reaction(held.model.surface(), &held.patch, away);
        bounds.push(Bound::new(OFF_FULL, off(want), FULL));
    }
    Ok(CaseOutcome::of(bounds).stepped(&held.body))
}

/// Applies an impulse at the tip and runs 5,000 free steps. The energy must never grow.
fn struck(bar: &BarBody, step: f64, integrator: Integrator) -> Result<CaseOutcome, LabError> {
    struck_model(bar, bar.bake()?, step, integrator)
}

/// [`struck`] with the model of another mesh.
fn struck_model(
    bar: &BarBody,
    model: Arc<ModalModel>,
    step: f64,
    integrator: Integrator,
) -> Result<CaseOutcome, LabError> {
    let settings = StepSettings { integrator, ..Default::default() };
    let mut body = Body::new(model.clone(), BodyConfig { step, settings, ..BodyConfig::default() })?;
    let impulse = 0.05 * bar.length * model.omega()[0] * model.mass();
    body.apply_impulse(bar.tip(&model)?.center(), [0.3 * impulse, impulse, -0.7 * impulse])?;
    // Generalized-alpha damps fast modes in a norm of its own that equals the energy within a
    // factor.
    if matches!(integrator, Integrator::GeneralizedAlpha { .. }) {
        let start = body.energy();
        let mut most = 0.0f64;
        for _ in 0..5_000 {
            body.step()?;
            most = most.max(body.energy() / start);
        }
        return Ok(CaseOutcome::of(vec![Bound::new("largest energy / energy at the start", most, 1.5)])
            .stepped(&body));
    }
    let [growth, _] = energy_growth(&mut body, 5_000)?;
    Ok(CaseOutcome::of(vec![no_growth(growth)]).stepped(&body))
}

/// Moves nodes inside the bar toward the opposite face of a tetrahedron, so that only `1 - share`
/// of the height is left.
fn slivers(mut mesh: TetMesh, share: f64) -> TetMesh {
    let [low, high] = mesh.bounds();
    let inside = |p: &[f64; 3]| (0..3).all(|k| p[k] > low[k] + 1e-9 && p[k] < high[k] - 1e-9);
    let tets = mesh.tets.clone();
    let mut moved = vec![false; mesh.nodes.len()];
    for tet in tets {
        let node = tet[0] as usize;
        let others = [1, 2, 3].map(|k| tet[k] as usize);
        if !inside(&mesh.nodes[node]) || moved[node] || others.iter().any(|&n| moved[n]) {
            continue;
        }
        let face = others.map(|n| Vector3::from(mesh.nodes[n]));
        let foot = (face[0] + face[1] + face[2]) / 3.0;
        let old = mesh.nodes[node];
        let at = Vector3::from(old);
        let normal = (face[1] - face[0]).cross(&(face[2] - face[0])).normalize();
        // The node moves along the normal only, so that its other tetrahedra keep their orientation
        // for as long as possible.
        mesh.nodes[node] = (at - normal * (at - foot).dot(&normal) * share).into();
        if mesh.check().is_err() {
            mesh.nodes[node] = old;
        } else {
            moved[node] = true;
        }
    }
    mesh
}

/// The bar with slices that grow along it. The last slice is `ratio` times as heavy as the first.
fn graded(bar: &BarBody, ratio: f64) -> Result<TetMesh, LabError> {
    let mut mesh = BarBody { cells: [16, 2, 2], ..bar.clone() }.mesh()?;
    let growth = ratio.powf(1.0 / 15.0);
    let whole = growth.powi(16) - 1.0;
    for node in &mut mesh.nodes {
        let slice = (node[0] / bar.length * 16.0).round() as i32;
        node[0] = bar.length * (growth.powi(slice) - 1.0) / whole;
    }
    Ok(mesh)
}
