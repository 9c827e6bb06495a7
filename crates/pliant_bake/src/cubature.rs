//! The cubature rule of a model, from shapes that a body takes when it is pulled, pressed and bent.
//!
//! The rule is complete: it integrates the whole energy, not what is left beside the linear part,
//! whose integrals a rule of few points may make negative.

use nalgebra::{Matrix3, Vector3};
use pliant_modal::cubature::{self, Fit, Point, Rows};
use pliant_modal::{ElasticEnergy, Material, ModelError, ReducedElasticity};
use rayon::prelude::*;

use crate::continuum::Continuum;
use crate::lanczos::Eigenpairs;

/// Largest number of points whose forces are the reference.
const REFERENCE: usize = 24_000;

/// Largest number of points to choose from.
const CANDIDATES: usize = 3_000;

/// Number of points that find the training shapes.
const COARSE: usize = 1_000;

/// Most points of a rule, by coordinate.
const POINTS_PER_COORDINATE: usize = 4;

/// Error of the forces over the training shapes at which no more points are added.
const TOLERANCE: f64 = 3e-3;

/// Largest energy density of a training shape, as a share of Young's modulus: a mean strain of
/// about a fifth.
const ENERGY: f64 = 0.02;

/// Ways of a hand in the training shapes, as shares of the body's size.
const WAYS: [f64; 4] = [0.04, 0.12, 0.25, 0.5];

/// What a rule is made for.
pub(crate) struct Training<'a> {
    pub(crate) continuum: Continuum<'a>,
    pub(crate) coordinates: &'a Eigenpairs,
    pub(crate) material: Material,
    pub(crate) young: f64,
    /// Patches of the surface that are pulled.
    pub(crate) patches: &'a [Rows],
    /// Largest extent of the body, m.
    pub(crate) size: f64,
}

/// Chooses the points and their weights.
///
/// # Errors
/// Returns an error if a gradient is not finite.
pub(crate) fn train(
    training: &Training<'_>,
    report: &mut dyn FnMut(f64),
) -> Result<ReducedElasticity, ModelError> {
    let lambda = &training.coordinates.lambda;
    let m = lambda.len();
    let reference = points(training, REFERENCE);
    report(0.1);
    let candidates = subset(&reference, CANDIDATES);
    let coarse = subset(&reference, COARSE);
    let rule = ReducedElasticity {
        material: training.material,
        weights: coarse.iter().map(|point| point.weight).collect(),
        gradients: coarse.iter().flat_map(|point| point.gradients.iter().map(|&x| x as f32)).collect(),
        mesh: None,
    };
    let omega: Vec<f64> = lambda.iter().map(|lambda| lambda.sqrt()).collect();
    let energy = ElasticEnergy::new(&rule, training.continuum.law, &omega)?;
    let shapes: Vec<Vec<f64>> = training
        .patches
        .par_iter()
        .flat_map(|patch| pulled(&mut energy.clone(), &omega, patch, training))
        .collect();
    report(0.4);
    let law = training.continuum.law;
    let forces: Vec<Vec<f64>> = shapes
        .par_iter()
        .map(|q| {
            let mut sum = vec![0.0; m];
            reference.iter().for_each(|point| point.add_force(law, q, &mut sum));
            sum
        })
        .collect();
    report(0.7);
    let mut stiffness = vec![0.0; m * m];
    lambda.iter().enumerate().for_each(|(i, lambda)| stiffness[i * m + i] = *lambda);
    let (most, tolerance) = (POINTS_PER_COORDINATE * m, TOLERANCE);
    let fit =
        Fit { law, omega: &omega, shapes: &shapes, forces: &forces, stiffness: &stiffness, tolerance, most };
    let chosen = cubature::choose(&candidates, &fit);
    report(0.95);
    let gradients: Vec<f32> =
        chosen.iter().flat_map(|&(c, _)| candidates[c].gradients.iter().map(|&x| x as f32)).collect();
    let weights: Vec<f64> = chosen.iter().map(|&(c, weight)| weight * candidates[c].weight).collect();
    Ok(ReducedElasticity { material: training.material, weights, gradients, mesh: None })
}

/// Returns at most about `most` points of the elements, spread over the body, with weights whose
/// sum is its volume.
fn points(training: &Training<'_>, most: usize) -> Vec<Point> {
    let (continuum, m) = (&training.continuum, training.coordinates.lambda.len());
    let elements = continuum.fe.affine.len();
    let per = pliant_modal::tetrahedron::stiffness_points(continuum.fe.element).0.len();
    let stride = (elements * per).div_ceil(most).max(1);
    // Elements in the order of a coarse grid lie beside each other, so that each stretch of the
    // list is a place of the body. Only elements of about the same moduli stand for each other,
    // because a stiff part strains less than the soft one beside it.
    let mut order: Vec<usize> = (0..elements).collect();
    let center = |index: usize| -> Vector3<f64> {
        let nodes = &continuum.nodes(index)[..4];
        nodes.iter().map(|&n| Vector3::from(continuum.fe.nodes[n as usize])).sum::<Vector3<f64>>() / 4.0
    };
    let cell = training.size / 16.0;
    let key = |index: usize| {
        let at = center(index);
        let place: [i64; 3] = std::array::from_fn(|k| (at[k] / cell).floor() as i64);
        (continuum.fe.stiffness[index].log2().round() as i64, place, index)
    };
    order.sort_by_cached_key(|&index| key(index));
    let groups: Vec<&[usize]> = order.chunks(stride).collect();
    groups
        .par_iter()
        .enumerate()
        .flat_map_iter(|(group, members)| {
            // All points of one element of each group, for the volume of the group.
            let volume: f64 = members.iter().map(|&e| continuum.fe.elastic_volume(e)).sum();
            let index = members[(group * 7919) % members.len()];
            let share = volume / continuum.fe.elastic_volume(index);
            let mut found = Vec::with_capacity(per);
            let mut gradients = vec![Matrix3::zeros(); m];
            let phi = &training.coordinates.phi;
            continuum.gradients_of_columns(index, phi, m, &mut gradients, |weight, _, gradients| {
                let mut rows = vec![0.0; 9 * m];
                for (column, h) in gradients.iter().enumerate() {
                    h.iter().enumerate().for_each(|(row, x)| rows[row * m + column] = *x);
                }
                found.push(Point { weight: share * weight, gradients: rows });
            });
            found
        })
        .collect()
}

/// Returns about `most` of the points, evenly from the list, with weights whose sum stays.
fn subset(points: &[Point], most: usize) -> Vec<Point> {
    let stride = points.len().div_ceil(most).max(1);
    let groups = points.chunks(stride).enumerate();
    groups
        .map(|(group, members)| {
            let mut point = members[(group * 7919) % members.len()].clone();
            point.weight = members.iter().map(|point| point.weight).sum();
            point
        })
        .collect()
}

/// Returns shapes in which a patch is pulled out, pressed in and pulled to both sides.
fn pulled(energy: &mut ElasticEnergy, omega: &[f64], patch: &Rows, training: &Training<'_>) -> Vec<Vec<f64>> {
    let lambda = &training.coordinates.lambda;
    let most = ENERGY * training.young * training.continuum.fe.volume();
    // The softest and the stiffest direction of the patch, both ways, and the one between.
    let soft = Matrix3::from_fn(|a, b| {
        lambda.iter().enumerate().map(|(i, lambda)| patch[a][i] * patch[b][i] / lambda).sum::<f64>()
    });
    let eigen = soft.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let axes: [Vector3<f64>; 3] = order.map(|k| eigen.eigenvectors.column(k).into_owned());
    let ways = WAYS.map(|way| way * training.size);
    [(0, 1.0), (0, -1.0), (1, 1.0), (2, 1.0), (2, -1.0)]
        .into_iter()
        .flat_map(|(axis, sign)| {
            cubature::guided_shapes(energy, omega, patch, &(sign * axes[axis]), &ways, most)
        })
        .map(|shape| shape.q)
        .collect()
}
