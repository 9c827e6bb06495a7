//! Validity checks on the parts of a model.

use nalgebra::Matrix3;

use crate::{
    BakeInfo, Coefficients, FlexibilitySite, Integrator, ModalModel, ModelError, ModelParts,
    ReducedElasticity,
};

/// Rounding tolerance for the symmetry of an inertia, as a share of its largest entry.
const INERTIA_ROUNDING: f64 = 1e-9;

/// Rounding tolerance for a residual flexibility, as a share of the compliances whose difference it
/// is.
const FLEXIBILITY_ROUNDING: f64 = 1e-7;

pub(crate) fn check_parts(parts: &ModelParts) -> Result<(), ModelError> {
    let modes = parts.omega.len();
    let vertices = parts.surface.positions().len();
    if modes == 0 {
        return Err(ModelError::Empty("mode"));
    }
    let length = |what, expected: usize, got: usize| {
        if expected == got { Ok(()) } else { Err(ModelError::Length { what, expected, got }) }
    };
    if modes > ModalModel::MAX_MODES {
        return Err(ModelError::Length { what: "omega", expected: ModalModel::MAX_MODES, got: modes });
    }
    length("damping", modes, parts.damping.len())?;
    length("participation", modes, parts.participation.len())?;
    length("displacement", modes * vertices * 3, parts.displacement.len())?;
    length("rotation", modes * vertices * 3, parts.rotation.len())?;

    let each = |what, expected, values: &mut dyn Iterator<Item = f64>, ok: &dyn Fn(f64) -> bool| match values
        .enumerate()
        .find(|&(_, x)| !(x.is_finite() && ok(x)))
    {
        None => Ok(()),
        Some((index, got)) => Err(ModelError::Value { what, index, expected, got }),
    };
    let any = |_: f64| true;
    let positive = |x: f64| x > 0.0;
    let not_negative = |x: f64| x >= 0.0;
    let info = &parts.info;
    check_texts(info)?;
    // The square is the stiffness of the mode, which is used as a divisor.
    each(
        "omega",
        "rad/s above 0, with a square above 0 and finite",
        &mut parts.omega.iter().copied(),
        &|x| x > 0.0 && (x * x).is_normal(),
    )?;
    each("omega", "ascending", &mut parts.omega.windows(2).map(|w| w[1] - w[0]), &not_negative)?;
    each("damping", "1/s, 0 or more", &mut parts.damping.iter().copied(), &not_negative)?;
    for (index, (&omega, &c)) in parts.omega.iter().zip(&parts.damping).enumerate() {
        // A step uses the roots of `s^2 + c s + omega^2`. The squares of `c` and `omega`, and all
        // coefficients of the step, must be finite.
        if !(c * c).is_finite() || Coefficients::new(Integrator::Exact, omega, c, 1.0 / 60.0).is_err() {
            let expected = "1/s that a step can be made of";
            return Err(ModelError::Value { what: "damping", index, expected, got: c });
        }
    }
    each("displacement", "finite", &mut parts.displacement.iter().map(|&x| f64::from(x)), &any)?;
    each("rotation", "finite", &mut parts.rotation.iter().map(|&x| f64::from(x)), &any)?;
    each("participation", "finite", &mut parts.participation.iter().flatten().copied(), &any)?;
    each("mass", "kg above 0", &mut [parts.mass].into_iter(), &positive)?;
    each("center_of_mass", "finite meters", &mut parts.center_of_mass.into_iter(), &any)?;
    each("inertia", "finite", &mut parts.inertia.into_iter().flatten(), &any)?;
    check_inertia(&parts.inertia)?;
    each("young", "Pa above 0", &mut [info.young].into_iter(), &positive)?;
    each("poisson", "-1 < nu < 0.5", &mut [info.poisson].into_iter(), &|x| x > -1.0 && x < 0.5)?;
    each("density", "kg/m^3 above 0", &mut [info.density].into_iter(), &positive)?;
    for (index, site) in parts.sites.iter().enumerate() {
        if site.vertex as usize >= vertices {
            return Err(ModelError::Vertex { what: "sites", index, vertex: site.vertex, count: vertices });
        }
        each("site radius", "m above 0", &mut [site.radius].into_iter(), &positive)?;
        each("site flexibility", "finite", &mut site.flexibility.into_iter().flatten(), &any)?;
        check_flexibility(parts, index)?;
    }
    let Some(reduced) = &parts.reduced else { return Ok(()) };
    check_reduced(reduced, &parts.omega)?;
    reduced.mesh.as_ref().map_or(Ok(()), |mesh| mesh.check(info.element, modes, vertices))
}

pub(crate) fn check_reduced(reduced: &ReducedElasticity, omega: &[f64]) -> Result<(), ModelError> {
    let modes = omega.len();
    let length = |what, expected: usize, got: usize| {
        if expected == got { Ok(()) } else { Err(ModelError::Length { what, expected, got }) }
    };
    let value = |what, expected, bad: Option<(usize, f64)>| match bad {
        None => Ok(()),
        Some((index, got)) => Err(ModelError::Value { what, index, expected, got }),
    };
    let points = reduced.points();
    if points == 0 {
        return Err(ModelError::Empty("cubature point"));
    }
    length("cubature points", points.min(ReducedElasticity::MAX_POINTS), points)?;
    length("cubature gradients", 9 * points * modes, reduced.gradients.len())?;
    let bad = reduced.weights.iter().copied().enumerate().find(|&(_, w)| !(w.is_finite() && w > 0.0));
    value("cubature weights", "m^3 above 0", bad)?;
    // The tangent works with gradients over frequencies in single precision.
    let scaled = |(index, &x): (usize, &f32)| (index, f64::from(x) / omega[index % modes]);
    let finite = |x: f64| (x as f32).is_finite();
    let bad = reduced.gradients.iter().enumerate().map(scaled).find(|&(_, x)| !finite(x));
    value("cubature gradients", "finite, also over the frequency", bad)
}

/// Checks that the inertia is symmetric and positive definite.
///
/// Cholesky reads one triangle only, so symmetry needs its own check. A step with an asymmetric
/// inertia would turn a body by itself.
fn check_inertia(inertia: &[[f64; 3]; 3]) -> Result<(), ModelError> {
    let inertia = Matrix3::from_fn(|i, j| inertia[i][j]);
    let wrong = |expected, got| Err(ModelError::Value { what: "inertia", index: 0, expected, got });
    let skew = (inertia - inertia.transpose()).amax();
    if skew > INERTIA_ROUNDING * inertia.amax() {
        return wrong("a symmetric matrix", skew);
    }
    if inertia.cholesky().is_none() {
        return wrong("a positive definite matrix", inertia[(0, 0)]);
    }
    Ok(())
}

fn check_texts(info: &BakeInfo) -> Result<(), ModelError> {
    let most = |what, unit, most: usize, got: usize| {
        if got <= most { Ok(()) } else { Err(ModelError::TooLong { what, most, unit, got }) }
    };
    most("name", "bytes", ModalModel::MAX_TEXT, info.name.len())?;
    most("anchors", "entries", ModalModel::MAX_ANCHORS, info.anchors.len())?;
    info.anchors.iter().try_for_each(|anchor| most("anchor", "bytes", ModalModel::MAX_TEXT, anchor.len()))
}

/// Checks that a residual flexibility is symmetric and positive semi-definite.
///
/// It is a small difference of two compliances, so the tolerance also depends on the compliance of
/// the kept modes.
fn check_flexibility(parts: &ModelParts, site: usize) -> Result<(), ModelError> {
    let FlexibilitySite { vertex, flexibility, .. } = &parts.sites[site];
    let f = Matrix3::from_fn(|i, j| flexibility[i][j]);
    let vertices = parts.surface.positions().len();
    let modal: f64 = parts
        .omega
        .iter()
        .enumerate()
        .map(|(mode, omega)| {
            let row = 3 * (mode * vertices + *vertex as usize);
            let phi = &parts.displacement[row..row + 3];
            phi.iter().map(|&p| (f64::from(p) / omega).powi(2)).sum::<f64>()
        })
        .sum();
    let rounding = FLEXIBILITY_ROUNDING * (f.abs().max() + modal);
    let wrong =
        |expected, got| Err(ModelError::Value { what: "site flexibility", index: site, expected, got });
    let skew = (f - f.transpose()).abs().max();
    if skew > rounding {
        return wrong("a symmetric matrix", skew);
    }
    let lowest = (0.5 * (f + f.transpose())).symmetric_eigenvalues().min();
    if lowest.is_nan() || lowest < -rounding {
        return wrong("a positive semi-definite matrix", lowest);
    }
    Ok(())
}
