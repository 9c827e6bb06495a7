//! The closed form of a stretched bar, for tests of the full and of the reduced solution.

/// Nominal stress of the neo-Hookean law in uniaxial tension, Pa, from its principal stresses
/// `P_i = mu (1 - 1 / (I_C + 1)) l_i + lambda (J - a) J / l_i` with free sides.
pub fn uniaxial(young: f64, poisson: f64, stretch: f64) -> f64 {
    let mu_lame = young / (2.0 * (1.0 + poisson));
    let lambda_lame = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson));
    let (mu, lambda) = (4.0 / 3.0 * mu_lame, lambda_lame + 5.0 / 6.0 * mu_lame);
    let a = 1.0 + mu / lambda - mu / (4.0 * lambda);
    let principal = |along: f64, side: f64, of: f64| {
        let (c, j) = (along * along + 2.0 * side * side, along * side * side);
        mu * (1.0 - 1.0 / (c + 1.0)) * of + lambda * (j - a) * j / of
    };
    let (mut low, mut high) = (0.3, 2.0);
    for _ in 0..100 {
        let side = 0.5 * (low + high);
        if principal(stretch, side, side) < 0.0 { low = side } else { high = side }
    }
    principal(stretch, low, stretch)
}
