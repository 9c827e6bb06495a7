//! The force in a hand beside full finite elements, which neither modes nor baked flexibilities
//! enter: of the same mesh, so that what the body leaves out shows, and of a fine mesh, so that
//! locking and the coarseness of the mesh show. Where elasticity is linear, these are the elements
//! of [`Solid`], which share no line with the bake's. For large strains they are those of the bake
//! ([`deflect`]), so that only what the reduction leaves out shows.

use std::sync::{Arc, OnceLock};

use nalgebra::Vector3;
use pliant_bake::{Anchor, BakeConfig, Comparison, PrescribedPatch, StaticLoads, bake, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{Damping, Elasticity, Element, Material, ModalModel, Patch};

use super::{
    Bound, Case, CaseOutcome, Expected,
    bodies::nearest_vertex,
    solid::{Solid, lame, timoshenko},
};
use crate::{
    LabError,
    pull::{Pull, pull},
};

const FORCE: &str = "|force - full finite elements| / full finite elements";

/// The same beside the bake's own full solution for large strains.
const OWN: &str = "|force - full solution of the bake| / full solution of the bake";

const LOCKS: &str = "four-node elements have one strain each and are too stiff where the body bends or keeps its volume; they are there for speed, and ten-node elements are the default";

const COARSE: &str = "elements four times as long as thick, five along a bar that bends";

/// A shape of size 1 m that is held at one end, and the place of a hand.
#[derive(Clone, Copy, PartialEq)]
enum Form {
    Bar,
    Cube,
    Ball,
}

impl Form {
    const ALL: [Self; 3] = [Self::Bar, Self::Cube, Self::Ball];

    fn name(self) -> &'static str {
        match self {
            Self::Bar => "bar 5 : 1",
            Self::Cube => "cube",
            Self::Ball => "ball",
        }
    }

    /// The mesh with a number of cells across the bar, or twice the number across the others.
    fn mesh(self, cells: usize) -> Result<TetMesh, LabError> {
        Ok(match self {
            Self::Bar => shapes::bar([5 * cells, cells, cells], [1.0, 0.2, 0.2])?,
            Self::Cube => shapes::cube(2 * cells, 1.0)?,
            Self::Ball => shapes::sphere(2 * cells, 0.5)?,
        })
    }

    /// The hand's place, m: the middle of the end, of a side and of the top.
    fn place(self) -> [f64; 3] {
        match self {
            Self::Bar => [1.0, 0.1, 0.1],
            Self::Cube => [0.5, 0.5, 1.0],
            Self::Ball => [0.0, 0.0, 0.5],
        }
    }

    /// Nodes whose x is below this are held, m.
    fn held(self) -> f64 {
        if self == Self::Ball { -0.3 } else { 1e-9 }
    }

    fn config(self, element: Element) -> BakeConfig {
        BakeConfig {
            element,
            modes: 24,
            damping: Damping::Ratio(0.3),
            anchors: vec![Anchor { axis: 0, comparison: Comparison::Less, bound: self.held() }],
            ..BakeConfig::linear()
        }
    }
}

/// A hand: the radius of its patch and its way, m.
#[derive(Clone, Copy)]
struct HandPull {
    radius: f64,
    by: [f64; 3],
}

/// So small a way that the linear theory is exact.
const SMALL: [f64; 3] = [0.5e-6, 1e-6, -0.7e-6];

pub(super) fn cases(out: &mut Vec<Case>) {
    let group = "full elements";
    for form in Form::ALL {
        for element in [Element::Tet4, Element::Tet10] {
            for radius in [0.06, 0.1, 0.2, 0.3] {
                let name = format!("{}, {element}, patch of {radius} of the size, same mesh", form.name());
                out.push(Case::new(group, name, move || {
                    let config = BakeConfig { sites: Some(96), ..form.config(element) };
                    same_mesh(form, &config, HandPull { radius, by: SMALL })
                }));
            }
        }
    }
    for poisson in [0.0, 0.45] {
        for young in [1e3, 1e9] {
            let name = format!("bar 5 : 1, nu {poisson}, E {young:.0e} Pa, same mesh");
            out.push(Case::new(group, name, move || {
                let config = BakeConfig { poisson, young, ..Form::Bar.config(Element::Tet10) };
                same_mesh(Form::Bar, &config, HandPull { radius: 0.12, by: SMALL })
            }));
        }
    }
    for element in [Element::Tet4, Element::Tet10] {
        // An even number of cells across has a vertex in the middle of the end.
        for cells in [[5, 2, 2], [20, 2, 2], [40, 2, 2], [20, 4, 4]] {
            let [x, y, z] = cells;
            let name = format!("bar 10 : 1, {element}, {x} x {y} x {z} cells, beside a fine mesh");
            let case = Case::new(group, name, move || fine_mesh(element, cells));
            // What a mesh is off by is one number, so that the ranges are narrow.
            let known: Option<(&str, &[_])> = match (element, cells) {
                (Element::Tet4, [5, ..]) => Some((LOCKS, &[(FORCE, 6.3, 6.8)])),
                (Element::Tet4, [20, 2, _]) => Some((LOCKS, &[(FORCE, 2.12, 2.3)])),
                (Element::Tet4, [40, ..]) => Some((LOCKS, &[(FORCE, 1.84, 1.99)])),
                (Element::Tet4, _) => Some((LOCKS, &[(FORCE, 0.8, 0.87)])),
                (_, [5, ..]) => Some((COARSE, &[(FORCE, 0.088, 0.096)])),
                _ => None,
            };
            out.push(limited(case, known));
        }
    }
    // The held end cannot contract, which a beam knows nothing of: at a Poisson ratio of 0 both are
    // the same, and near one half the bar is stiffer by some percents.
    for (poisson, limit) in [(0.0, 0.01), (SOFT, 0.05)] {
        let name = format!("bar 10 : 1, nu {poisson}, the fine mesh beside Timoshenko's beam");
        out.push(Case::new(group, name, move || {
            let beam = timoshenko(BakeConfig::linear().young, poisson, 1.0, 0.1);
            Ok(off(FORCE, slender_solid(poisson)?, Vector3::from(BEND) * -beam, limit))
        }));
    }
    for element in [Element::Tet4, Element::Tet10] {
        for cells in [[20, 2, 2], [40, 2, 2], [20, 4, 4]] {
            let [x, y, z] = cells;
            let name = format!("bar 10 : 1, nu {SOFT}, {element}, {x} x {y} x {z} cells, beside a fine mesh");
            let case = Case::new(group, name, move || {
                Ok(off(FORCE, bent(element, cells, SOFT)?, nearly_incompressible()?, 0.05))
            });
            let known: Option<(&str, &[_])> = match (element, cells) {
                (Element::Tet10, _) => None,
                (_, [40, ..]) => Some((LOCKS, &[(FORCE, 1.41, 1.52)])),
                (_, [_, 2, _]) => Some((LOCKS, &[(FORCE, 1.88, 2.04)])),
                _ => Some((LOCKS, &[(FORCE, 0.647, 0.7)])),
            };
            out.push(limited(case, known));
        }
    }
    for material in [Material::NeoHookean, Material::StVenantKirchhoff] {
        for (name, by) in [
            ("bent by a tenth", [0.0, 0.1, 0.0]),
            ("bent by three tenths", [-0.05, 0.3, 0.0]),
            ("stretched by a tenth", [0.1, 0.0, 0.0]),
            ("pressed by a twentieth", [-0.05, 0.0, 0.0]),
            ("all at once", [0.05, 0.15, -0.1]),
        ] {
            out.push(Case::new(group, format!("bar 5 : 1, reduced, {material}, {name}"), move || {
                reduced(material, by)
            }));
        }
    }
}

/// A case, and the results by which it breaks its bound, if it does, with their reason.
fn limited(case: Case, known: Option<(&'static str, &'static [(&'static str, f64, f64)])>) -> Case {
    match known {
        Some((why, results)) => case.limited(why, Expected::Measured(results)),
        None => case,
    }
}

fn made(mesh: &TetMesh, config: &BakeConfig) -> Result<Arc<ModalModel>, LabError> {
    Ok(Arc::new(bake(mesh, None, config, &mut |_, _| ())?.model))
}

/// The surface of a mesh, in a model of as little as possible, and the patch of a hand on it.
fn patch_on(
    mesh: &TetMesh,
    element: Element,
    form: Form,
    at: [f64; 3],
    radius: f64,
) -> Result<(Arc<ModalModel>, Patch), LabError> {
    // The surface of a model is that of its mesh, and one mode suffices for it.
    let model = made(mesh, &BakeConfig { modes: 1, sites: Some(1), ..form.config(element) })?;
    let patch = Patch::around(model.surface(), nearest_vertex(&model, at), radius)?;
    Ok((model, patch))
}

/// The force of full finite elements on a hand by linear theory, N: those of the matrix, of
/// displacements alone.
fn solid(
    form: Form,
    at: [f64; 3],
    mesh: &TetMesh,
    config: &BakeConfig,
    held: HandPull,
) -> Result<Vector3<f64>, LabError> {
    let (model, patch) = patch_on(mesh, config.element, form, at, held.radius)?;
    let solid = Solid::new(mesh, config.element, lame(config.young, config.poisson), form.held());
    Ok(solid.reaction(model.surface(), &patch, held.by))
}

/// The force of the bake's own full solution on a hand, N, with a material for large strains.
fn full_solution(
    form: Form,
    mesh: &TetMesh,
    config: &BakeConfig,
    material: Material,
    held: HandPull,
) -> Result<Vector3<f64>, LabError> {
    let (_, patch) = patch_on(mesh, config.element, form, form.place(), held.radius)?;
    let prescribed = [PrescribedPatch { patch, displacement: held.by }];
    let loads = StaticLoads { prescribed: &prescribed, ..StaticLoads::default() };
    let solved = deflect(mesh, config, material, &loads)?;
    Ok(solved.reactions.first().map_or_else(|| Vector3::repeat(f64::NAN), |force| (*force).into()))
}

/// The force of the body on a hand, N, when it is at rest.
fn static_reaction(
    at: [f64; 3],
    model: &Arc<ModalModel>,
    elasticity: Elasticity,
    held: HandPull,
) -> Result<Vector3<f64>, LabError> {
    let hand = Pull { at, radius: held.radius, by: held.by, elasticity: Some(elasticity), gravity: [0.0; 3] };
    Ok(pull(model, &hand)?.reaction.into())
}

fn off(what: &'static str, got: Vector3<f64>, want: Vector3<f64>, limit: f64) -> CaseOutcome {
    CaseOutcome::of(vec![Bound::new(what, (got - want).norm() / want.norm(), limit)])
}

fn same_mesh(form: Form, config: &BakeConfig, held: HandPull) -> Result<CaseOutcome, LabError> {
    let mesh = form.mesh(2)?;
    let got = static_reaction(form.place(), &made(&mesh, config)?, Elasticity::Linear, held)?;
    // In the bar the patch is a large part of the end, and all of it moves alike.
    let limit = if form == Form::Bar && config.sites.is_some() { 5e-3 } else { 0.02 };
    Ok(off(FORCE, got, solid(form, form.place(), &mesh, config, held)?, limit))
}

/// Edges of a slender bar that a hand at its end bends, so that the shape of the patch matters
/// little, m.
const SLENDER: [f64; 3] = [1.0, 0.1, 0.1];
/// Its end, m.
const END: [f64; 3] = [1.0, 0.05, 0.05];
/// The hand's way, m.
const BEND: [f64; 3] = [0.0, 1e-6, 0.5e-6];
const SLENDER_HAND: HandPull = HandPull { radius: 0.06, by: BEND };
/// Cells of the fine mesh, of ten-node elements.
const FINE: [usize; 3] = [40, 4, 4];
/// The Poisson ratio of a body that hardly changes its volume.
const SOFT: f64 = 0.499;

/// The force of a slender bar, N.
fn bent(element: Element, cells: [usize; 3], poisson: f64) -> Result<Vector3<f64>, LabError> {
    let config = BakeConfig { poisson, ..Form::Bar.config(element) };
    let body = made(&shapes::bar(cells, SLENDER)?, &config)?;
    static_reaction(END, &body, Elasticity::Linear, SLENDER_HAND)
}

fn fine_mesh(element: Element, cells: [usize; 3]) -> Result<CaseOutcome, LabError> {
    static FORCE_OF_MESH: OnceLock<Vector3<f64>> = OnceLock::new();
    let poisson = Form::Bar.config(element).poisson;
    let got = bent(element, cells, poisson)?;
    let limit = if cells[0] == 5 { 0.05 } else { 0.02 };
    Ok(off(FORCE, got, once(&FORCE_OF_MESH, poisson)?, limit))
}

/// [`slender_solid`] of a body that hardly changes its volume. (Above a Poisson ratio of 0.45 the
/// bake averages the pressure, and its static solution refuses the material.)
fn nearly_incompressible() -> Result<Vector3<f64>, LabError> {
    static FORCE_OF_MESH: OnceLock<Vector3<f64>> = OnceLock::new();
    once(&FORCE_OF_MESH, SOFT)
}

/// [`slender_solid`] for several cases that share it.
fn once(force: &OnceLock<Vector3<f64>>, poisson: f64) -> Result<Vector3<f64>, LabError> {
    if let Some(force) = force.get() {
        return Ok(*force);
    }
    let solved = slender_solid(poisson)?;
    Ok(*force.get_or_init(|| solved))
}

/// The force of the fine mesh of a slender bar, N.
fn slender_solid(poisson: f64) -> Result<Vector3<f64>, LabError> {
    let config = BakeConfig { poisson, ..Form::Bar.config(Element::Tet10) };
    solid(Form::Bar, END, &shapes::bar(FINE, SLENDER)?, &config, SLENDER_HAND)
}

fn reduced(material: Material, by: [f64; 3]) -> Result<CaseOutcome, LabError> {
    let (form, held) = (Form::Bar, HandPull { radius: 0.15, by });
    let mesh = form.mesh(2)?;
    let config = BakeConfig {
        modes: BakeConfig::COORDINATES,
        material: Some(material),
        ..form.config(Element::Tet10)
    };
    let got = static_reaction(form.place(), &made(&mesh, &config)?, Elasticity::Reduced, held)?;
    Ok(off(OWN, got, full_solution(form, &mesh, &config, material, held)?, 0.03))
}
