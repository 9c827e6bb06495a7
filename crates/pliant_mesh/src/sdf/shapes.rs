//! Shapes whose distance has a closed form or needs a short iteration.

use nalgebra::Vector3;

/// Returns the distance from a sphere.
pub(super) fn sphere(p: Vector3<f64>, center: Vector3<f64>, radius: f64) -> f64 {
    (p - center).norm() - radius
}

/// Returns the distance from the hull of two spheres, which is a capsule if the radii are equal.
///
/// In the plane through the axis the sides are two straight lines whose normal leans by asin((r0 -
/// r1)/length). A point whose foot falls off the end of such a line is nearest to the sphere at
/// that end.
pub(super) fn round_cone(p: Vector3<f64>, [from, to]: [Vector3<f64>; 2], [r0, r1]: [f64; 2]) -> f64 {
    let axis = to - from;
    let length = axis.norm();
    let lean = (r0 - r1) / length;
    // One sphere contains the other.
    if length <= (r0 - r1).abs() {
        return if r0 >= r1 { sphere(p, from, r0) } else { sphere(p, to, r1) };
    }
    let cos = (1.0 - lean * lean).sqrt();
    let along = (p - from).dot(&axis) / length;
    let away = (p - from - axis * (along / length)).norm();
    let foot = along * cos - away * lean;
    if foot < 0.0 {
        sphere(p, from, r0)
    } else if foot > length * cos {
        sphere(p, to, r1)
    } else {
        away * cos + along * lean - r0
    }
}

/// Returns the distance from an ellipsoid around the origin with its axes along x, y and z.
///
/// The nearest point is r_i^2 p_i / (t + r_i^2) with the largest root t of sum (r_i p_i / (t +
/// r_i^2))^2 = 1 (D. Eberly, *Distance from a Point to an Ellipse, an Ellipsoid, or a
/// Hyperellipsoid*). Right of its last pole the sum is decreasing and convex, so Newton's method
/// approaches the root from the left and cannot pass it.
pub(super) fn ellipsoid(p: Vector3<f64>, radii: Vector3<f64>) -> f64 {
    let shortest = radii.imin();
    let mut p = p.abs();
    // On the plane across the shortest axis the root may coincide with the pole. Beside this plane
    // it does not.
    p[shortest] = p[shortest].max(1e-12 * radii[shortest]);
    let squares = radii.component_mul(&radii);
    let weighted = radii.component_mul(&p);
    let inside = p.component_div(&radii).norm_squared() < 1.0;
    // The iteration stores the distance s of t from the pole, because s may be tiny. Each other
    // denominator is s plus a gap. The start value makes the term of the shortest axis alone equal
    // to 1.
    let gaps = squares.add_scalar(-squares[shortest]);
    let mut s = weighted[shortest];
    for _ in 0..100 {
        let below = gaps.add_scalar(s);
        let terms = weighted.component_div(&below);
        let value = terms.norm_squared() - 1.0;
        let slope = -2.0 * terms.component_mul(&terms).component_div(&below).sum();
        let step = -value / slope;
        if step <= 1e-15 * s {
            break;
        }
        s += step;
    }
    let nearest = squares.component_mul(&p).component_div(&gaps.add_scalar(s));
    let distance = (p - nearest).norm();
    if inside { -distance } else { distance }
}

/// Returns the union of two shapes with a fillet where they are within `blend` meters of each
/// other.
///
/// The result changes by at most 1 m per meter if both shapes do.
pub(super) fn smooth_union(a: f64, b: f64, blend: f64) -> f64 {
    let overlap = (blend - (a - b).abs()).max(0.0);
    let fillet = if blend > 0.0 { overlap * overlap / (4.0 * blend) } else { 0.0 };
    a.min(b) - fillet
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_round_cone_is_the_hull_of_its_spheres() {
        let ends = [Vector3::new(0.0, 0.0, 0.0), Vector3::new(0.0, 0.0, 2.0)];
        let radii = [0.7, 0.3];
        for n in 1..500 {
            let x = |a: f64| (f64::from(n) * a).fract() * 5.0 - 2.0;
            let p = Vector3::new(x(0.819_172_513), x(0.671_043_606), x(0.549_700_478));
            // The hull of two spheres is the union of all spheres between them.
            let spheres = (0..=4000).map(|i| {
                let t = f64::from(i) / 4000.0;
                sphere(p, ends[0].lerp(&ends[1], t), 0.7 * (1.0 - t) + 0.3 * t)
            });
            let union = spheres.fold(f64::INFINITY, f64::min);
            let distance = round_cone(p, ends, radii);
            // Inside a union of spheres the distance is not exact, but the sign is.
            if union > 0.0 {
                assert!((distance - union).abs() < 1e-6, "{p:?}: {distance} {union}");
            }
            assert_eq!(distance > 0.0, union > 0.0, "{p:?}");
        }
        assert!((round_cone(Vector3::new(0.0, 0.0, 5.0), ends, [1.0, 5.0]) + 2.0).abs() < 1e-15, "swallowed");
    }

    #[test]
    fn an_ellipsoid_s_distance_is_that_of_its_nearest_point() {
        let radii = Vector3::new(0.5, 1.0, 0.3);
        let at = |u: f64, v: f64| {
            radii.component_mul(&Vector3::new(u.cos() * v.cos(), u.sin() * v.cos(), v.sin()))
        };
        for n in 1..60 {
            let x = |a: f64| (f64::from(n) * a).fract() * 3.0 - 1.5;
            let p = Vector3::new(x(0.819_172_513), x(0.671_043_606), x(0.549_700_478));
            let mut nearest = f64::INFINITY;
            for i in 0..400 {
                for j in 0..200 {
                    let (u, v) = (f64::from(i) / 400.0, f64::from(j) / 200.0 - 0.5);
                    nearest =
                        nearest.min((at(std::f64::consts::TAU * u, std::f64::consts::PI * v) - p).norm());
                }
            }
            let distance = ellipsoid(p, radii);
            assert!((distance.abs() - nearest).abs() < 2e-3, "{p:?}: {distance} {nearest}");
            assert_eq!(distance < 0.0, p.component_div(&radii).norm() < 1.0);
        }
        // The formula is most likely to fail at the center and at the poles.
        assert!((ellipsoid(Vector3::zeros(), radii) + 0.3).abs() < 1e-9);
        assert!((ellipsoid(Vector3::new(0.0, 1.5, 0.0), radii) - 0.5).abs() < 1e-9);
        assert!(ellipsoid(Vector3::new(0.5, 0.0, 0.0), radii).abs() < 1e-9);
        assert!((ellipsoid(Vector3::new(2.0, 0.0, 0.0), Vector3::repeat(1.0)) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_smooth_union_is_a_union_away_from_the_seam_and_a_quarter_blend_fuller_on_it() {
        assert_eq!(smooth_union(0.3, 0.1, 0.2), 0.1);
        assert!((smooth_union(0.1, 0.1, 0.2) - 0.05).abs() < 1e-15);
        assert_eq!(smooth_union(0.1, 0.1, 0.0), 0.1);
    }
}
