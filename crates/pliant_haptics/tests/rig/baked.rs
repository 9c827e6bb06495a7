//! A baked body with another material and size. The geometry and the mode shapes stay, and
//! everything else scales by dimension.

use std::path::Path;

use pliant_modal::{FlexibilitySite, ModalModel, ModelParts, SurfaceMesh};

/// Reads the anchored body that the project ships.
pub fn pip() -> ModalModel {
    asset("pip.modal")
}

/// Reads the free body that the project ships.
pub fn jack() -> ModalModel {
    asset("jack.modal")
}

fn asset(name: &str) -> ModalModel {
    ModalModel::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets").join(name)).unwrap()
}

/// Returns `model` with Young's modulus `young` (Pa) and the largest extent `size` (m). Density,
/// Poisson ratio and damping ratio stay.
///
/// With lengths scaled by `s` and Young's modulus by `e`, masses scale as `s^3` and stiffnesses as
/// `e s`. Frequencies therefore scale as `sqrt(e) / s`, mass-normalized shapes as `s^-3/2` and
/// compliances as `1 / (e s)`.
pub fn made_of(model: &ModalModel, young: f64, size: f64) -> ModalModel {
    let parts = model.parts();
    let (s, e) = (size / model.size(), young / parts.info.young);
    let scheduler = e.sqrt() / s;
    let scaled = |values: &[f32], by: f64| values.iter().map(|x| (f64::from(*x) * by) as f32).collect();
    let surface = &parts.surface;
    let positions = surface.positions().iter().map(|p| p.map(|x| (f64::from(x) * s) as f32)).collect();
    let matrix = |m: [[f64; 3]; 3], by: f64| m.map(|row| row.map(|x| x * by));
    ModalModel::from_parts(ModelParts {
        info: pliant_modal::BakeInfo { young, ..parts.info.clone() },
        surface: SurfaceMesh::new(positions, surface.triangles().to_vec(), None, surface.anchored().to_vec())
            .unwrap(),
        omega: parts.omega.iter().map(|w| w * scheduler).collect(),
        damping: parts.damping.iter().map(|c| c * scheduler).collect(),
        displacement: scaled(&parts.displacement, s.powf(-1.5)),
        rotation: scaled(&parts.rotation, s.powf(-2.5)),
        participation: parts.participation.iter().map(|p| p.map(|x| x * s.powf(1.5))).collect(),
        free: parts.free,
        mass: parts.mass * s.powi(3),
        center_of_mass: parts.center_of_mass.map(|x| x * s),
        inertia: matrix(parts.inertia, s.powi(5)),
        sites: parts
            .sites
            .iter()
            .map(|site| FlexibilitySite {
                vertex: site.vertex,
                radius: site.radius * s,
                flexibility: matrix(site.flexibility, 1.0 / (e * s)),
            })
            .collect(),
        reduced: None,
    })
    .unwrap()
}

/// Returns the highest surface vertex, such as an ear or a head.
pub fn top(model: &ModalModel) -> u32 {
    let positions = model.surface().positions();
    (0..positions.len()).max_by(|&a, &b| positions[a][1].total_cmp(&positions[b][1])).unwrap() as u32
}
