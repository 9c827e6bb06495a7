//! The exact solution of one contact with Coulomb friction.

use nalgebra::{Matrix3, RowVector3, Vector2, Vector3};

/// Result of [`solve`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Status {
    /// The contact is open and has no force.
    #[default]
    Open,
    /// The contact sticks to its anchor.
    Stick,
    /// The contact slides.
    Slip,
}

/// Largest number of rounds for the direction of a slip.
const ROUNDS: usize = 60;

/// Force of one contact with Signorini's law in the normal and Coulomb's in the tangents, N, and
/// whether it slides. The first number is along the normal, the others along two tangents.
///
/// `free` is the gap (m) and the tangential offset from where the contact sticks (m) without the
/// force. `response` is what a unit force adds to them, symmetric and positive definite, m/N.
/// `guess` is a force of about the same direction. What is not finite gives no force.
pub fn contact_force(
    response: &Matrix3<f64>,
    free: &Vector3<f64>,
    friction: f64,
    guess: &Vector3<f64>,
) -> (Vector3<f64>, bool) {
    let (force, status) = solve(response, free, friction, guess);
    let sound = force.iter().all(|x| x.is_finite());
    if sound { (force, status == Status::Slip) } else { (Vector3::zeros(), false) }
}

/// Solves `gap = free + response force` for the force (N; normal first, then two tangents) with
/// Signorini's law in the normal and Coulomb's in the tangents.
///
/// `free` is the gap (m) and the tangential offset from the anchor (m) without the force.
/// `response` is symmetric and positive definite, m/N.
pub(crate) fn solve(
    response: &Matrix3<f64>,
    free: &Vector3<f64>,
    friction: f64,
    guess: &Vector3<f64>,
) -> (Vector3<f64>, Status) {
    // Comparisons with numbers that are none are false, and such contacts are open.
    if free[0].is_nan() || free[0] >= 0.0 {
        return (Vector3::zeros(), Status::Open);
    }
    if friction > 0.0
        && let Some(factor) = response.cholesky()
    {
        let force = -factor.solve(free);
        if force[0] >= 0.0 && force[1].hypot(force[2]) <= friction * force[0] {
            return (force, Status::Stick);
        }
    }
    let nn = response[(0, 0)];
    if friction == 0.0 {
        return (Vector3::new(-free[0] / nn, 0.0, 0.0), Status::Slip);
    }
    let across = Vector2::new(response[(1, 0)], response[(2, 0)]);
    let along = response.fixed_view::<2, 2>(1, 1).into_owned();
    let offset = Vector2::new(free[1], free[2]);
    // The largest eigenvalue of the tangential response. Steps of its inverse always contract.
    let (mean, half) = (0.5 * along.trace(), 0.5 * (along[(0, 0)] - along[(1, 1)]));
    let steepest = mean + half.hypot(along[(0, 1)]);
    let normal = |tangential: &Vector2<f64>| {
        // The force along the normal for this direction of slip. Friction that would press the
        // contact into the obstacle without limit is bounded.
        -free[0] / (nn + friction * across.dot(tangential)).max(1e-2 * nn)
    };
    let unit = |v: Vector2<f64>| {
        let length = v.norm();
        (length > 0.0 && length.is_finite()).then(|| v / length)
    };
    let first = unit(Vector2::new(guess[1], guess[2]))
        .or_else(|| unit(-(offset - across * (free[0] / nn))))
        .unwrap_or_else(Vector2::x);
    let mut slip = first;
    for _ in 0..ROUNDS {
        let n = normal(&slip);
        let pull = friction * n * slip;
        let slid = offset + across * n + along * pull;
        let Some(next) = unit(pull - slid / steepest) else { break };
        let moved = (next - slip).norm();
        slip = next;
        if moved < 1e-14 {
            break;
        }
    }
    let n = normal(&slip);
    (Vector3::new(n, friction * n * slip[0], friction * n * slip[1]), Status::Slip)
}

/// Derivative of the force of [`solve`] by `-free`, N/m, where the surface slides by `slid` (m)
/// against its force. It is exact where the response does not couple normal and tangents.
pub(super) fn stiffness(
    response: &Matrix3<f64>,
    force: &Vector3<f64>,
    slid: f64,
    status: Status,
) -> Matrix3<f64> {
    match status {
        Status::Open => Matrix3::zeros(),
        Status::Stick => response.try_inverse().unwrap_or_else(Matrix3::zeros),
        Status::Slip => {
            let along = force / force[0];
            let soft = (response.row(0) * along)[0];
            if !(along.iter().all(|x| x.is_finite()) && soft > 0.0) {
                return Matrix3::zeros();
            }
            let mut stiffness = along * RowVector3::new(1.0 / soft, 0.0, 0.0);
            let friction = force[1].hypot(force[2]);
            if friction > 0.0 {
                // The slip turns with the way across it.
                let across = Vector3::new(0.0, -force[2], force[1]) / friction;
                let soft = across.dot(&(response * across)) + slid / friction;
                if soft > 0.0 {
                    stiffness += across * across.transpose() / soft;
                }
            }
            stiffness
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_solution_obeys_signorini_and_coulomb() {
        for seed in 0..500 {
            let at = |k: f64| (f64::from(seed) * k).sin();
            let root = Matrix3::from_fn(|i, j| at(1.0 + (3 * i + j) as f64 * 0.37));
            let response = root * root.transpose() + Matrix3::identity() * 0.3;
            let free = Vector3::new(at(0.3), 2.0 * at(0.9), 2.0 * at(1.7));
            let friction = 0.8 * at(2.3).abs();
            let (force, status) = solve(&response, &free, friction, &Vector3::zeros());
            let gap = free + response * force;
            let (n, t) = (force[0], force[1].hypot(force[2]));
            match status {
                Status::Open => assert!(free[0] >= 0.0 && force == Vector3::zeros()),
                Status::Stick => {
                    assert!(gap.norm() < 1e-12 && t <= friction * n * (1.0 + 1e-12), "{seed}: {gap}");
                }
                Status::Slip => {
                    let along = gap[1] * force[1] + gap[2] * force[2];
                    let across = gap[1] * force[2] - gap[2] * force[1];
                    let bounded = response[(0, 0)] * 0.02
                        > response[(0, 0)] + (response[(0, 1)] * force[1] + response[(0, 2)] * force[2]) / n;
                    if !bounded {
                        assert!(gap[0].abs() < 1e-10 && n > 0.0, "{seed}: {gap}");
                        assert!((t - friction * n).abs() < 1e-10);
                        // The direction converges linearly, slowly where both responses mix.
                        let straight = across.abs() < 1e-6 + 1e-2 * along.abs();
                        assert!(along <= 1e-9 && straight, "{seed}: {along} {across}");
                    }
                }
            }
        }
    }

    #[test]
    fn no_number_is_an_open_contact() {
        let nan = Vector3::new(f64::NAN, 0.0, 0.0);
        assert_eq!(solve(&Matrix3::identity(), &nan, 0.5, &nan).1, Status::Open);
    }
}
