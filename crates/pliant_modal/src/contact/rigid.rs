//! Rigid bodies of another engine, which give way to the bodies that touch them.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use super::{ObstacleShape, SurfacePoint};

/// A rigid body of another engine in one step. Obstacles that belong to it name it by its key
/// ([`ObstacleShape::rigid`]), and are pushed: within the step the body responds to the forces of
/// the contacts, and the step returns their sum.
///
/// The other engine does the step of the rigid body. It must apply the force and the torque, and
/// should let [`Rigid::weight`] of their displacement happen in the step, as of that of
/// [`Rigid::acceleration`].
#[derive(Debug, Clone, Default)]
pub struct Rigid {
    /// Name of the body, which no other of the step has.
    pub key: [u64; 2],
    /// Center of mass at the beginning of the step, m, world axes.
    pub center: [f64; 3],
    /// Rotation from body to world axes at the beginning of the step, x, y, z, w.
    pub rotation: [f64; 4],
    /// Velocity of the center of mass at the beginning of the step, m/s.
    pub velocity: [f64; 3],
    /// Angular velocity at the beginning of the step, rad/s, world axes.
    pub angular_velocity: [f64; 3],
    /// Acceleration by everything but contacts, as gravity, m/s^2.
    pub acceleration: [f64; 3],
    /// Inverse mass along the world axes, 1/kg. Zero where the body is locked.
    pub inverse_mass: [f64; 3],
    /// Inverse inertia about the center of mass, 1/(kg m^2), world axes.
    pub inverse_inertia: [[f64; 3]; 3],
    /// Whether the body sleeps in its engine. Then it wakes no body. Default: false.
    pub rests: bool,
    /// Where the body touches others of its engine.
    pub supports: Vec<Support>,
    /// Set by a step: mean force of contacts and attachments, N.
    pub force: [f64; 3],
    /// Set by a step: mean torque of both about the center of mass, N m, world axes.
    pub torque: [f64; 3],
    /// Set by a step: the displacement of the body by the force and the acceleration, as a share of
    /// `h^2` times the acceleration that they give, 0.5 to 1.
    pub weight: f64,
    /// Set by a step: whether a support holds the body against the contacts.
    pub is_held: bool,
    /// Set by a step: displacement by the force and the acceleration, m, world axes.
    pub displacement: Vector3<f64>,
    /// Set by a step: turn by the torque, rad, world axes.
    pub turn: Vector3<f64>,
    /// Set by a step: the bodies that may touch it, by their indices.
    pub near: Vec<usize>,
}

/// A place where a [`Rigid`] touches a body of its own engine. A step takes from it what the body
/// can give way. The force is that engine's work; what the step expects may begin its solver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Support {
    /// The other body, if it is one of the step and gives way too.
    pub other: Option<[u64; 2]>,
    /// Place at the beginning of the step, m.
    pub point: [f64; 3],
    /// Unit normal, from the other to this body.
    pub normal: [f64; 3],
    /// Gap at the beginning of the step, m.
    pub gap: f64,
    /// Coefficient of friction.
    pub friction: f64,
    /// Velocity of the other's material there, m/s. It counts only if the other does not give way.
    pub velocity: [f64; 3],
    /// Force along the normal, N: what holds the body before a step, as far as it is known, and
    /// set by a step.
    pub force: f64,
}

impl Support {
    /// Whether all numbers are finite.
    pub(crate) fn is_sound(&self) -> bool {
        let vectors = [self.point, self.normal, self.velocity];
        vectors.iter().flatten().chain(&[self.gap, self.friction]).all(|x| x.is_finite())
    }
}

impl Rigid {
    /// Whether all numbers are finite.
    pub(crate) fn is_sound(&self) -> bool {
        let vectors = [self.center, self.velocity, self.angular_velocity, self.acceleration];
        let masses = self.inverse_mass.iter().chain(self.inverse_inertia.iter().flatten());
        vectors.iter().flatten().chain(&self.rotation).all(|x| x.is_finite())
            && masses.clone().all(|x| x.is_finite())
            && self.inverse_mass.iter().all(|x| *x >= 0.0)
    }

    /// Inverse inertia about the center of mass, 1/(kg m^2), world axes.
    pub(crate) fn inertia(&self) -> Matrix3<f64> {
        Matrix3::from_fn(|i, j| self.inverse_inertia[i][j])
    }

    /// Center of mass at the end of the step without forces, m.
    fn free_center(&self, h: f64) -> Vector3<f64> {
        Vector3::from(self.center) + h * Vector3::from(self.velocity)
    }

    /// The center about which a force turns the body in this step: the angular momentum that it
    /// adds is `h (point - center) x force` about any point.
    pub(crate) fn pivot(&self, weight: f64, h: f64) -> Vector3<f64> {
        Vector3::from(self.center) + (1.0 - weight) * h * Vector3::from(self.velocity)
    }

    /// Takes the displacement of the step under a force (N) and a torque (N m).
    pub(crate) fn respond(&mut self, force: &Vector3<f64>, torque: &Vector3<f64>, weight: f64, h: f64) {
        let acceleration =
            Vector3::from(self.acceleration) + Vector3::from(self.inverse_mass).component_mul(force);
        self.weight = weight;
        self.displacement = weight * h * h * acceleration;
        self.turn = weight * h * h * (self.inertia() * torque);
    }

    /// Displacement of the material at a point (m) at the beginning of the step, m.
    pub(crate) fn displacement(&self, point: &Vector3<f64>, h: f64) -> Vector3<f64> {
        let arm = point - Vector3::from(self.center);
        let spin = h * Vector3::from(self.angular_velocity) + self.turn;
        h * Vector3::from(self.velocity) + self.displacement + spin.cross(&arm)
    }

    /// Where the material that is at `point` (m) at the end of the step would be without forces.
    pub(crate) fn pull_back(&self, point: &Vector3<f64>, h: f64) -> Vector3<f64> {
        let center = self.free_center(h);
        center + UnitQuaternion::from_scaled_axis(-self.turn) * (point - center - self.displacement)
    }

    fn turned(&self) -> UnitQuaternion<f64> {
        let [x, y, z, w] = self.rotation;
        UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-9).unwrap_or_default()
    }

    /// A point of the body's axes (m) at the beginning of the step, world axes.
    pub(crate) fn to_world(&self, local: &Vector3<f64>) -> Vector3<f64> {
        Vector3::from(self.center) + self.turned() * local
    }

    /// A point of the body's axes (m) at the beginning of the step, and at its end without forces,
    /// world axes.
    pub(crate) fn path(&self, local: &Vector3<f64>, h: f64) -> (Vector3<f64>, Vector3<f64>) {
        let arm = self.turned() * local;
        let free = UnitQuaternion::from_scaled_axis(h * Vector3::from(self.angular_velocity));
        (Vector3::from(self.center) + arm, self.free_center(h) + free * arm)
    }

    /// A point of the body's axes (m) at the end of the step, world axes.
    pub(crate) fn end(&self, local: &Vector3<f64>, h: f64) -> Vector3<f64> {
        let (center, (_, free)) = (self.free_center(h), self.path(local, h));
        center + self.displacement + UnitQuaternion::from_scaled_axis(self.turn) * (free - center)
    }

    /// A point at the end of the step (m) in the body's axes.
    pub(crate) fn to_local(&self, point: &Vector3<f64>, h: f64) -> Vector3<f64> {
        let free = UnitQuaternion::from_scaled_axis(h * Vector3::from(self.angular_velocity));
        (free * self.turned()).inverse() * (self.pull_back(point, h) - self.free_center(h))
    }

    /// Writes three rows of six: the response to a unit force along an axis at `arm` is a row times
    /// another, for a weight of 1.
    pub(crate) fn fill_rows(&self, axes: &Matrix3<f64>, arm: &Vector3<f64>, h: f64, rows: &mut [f64]) {
        // Where an axis is locked the inverse has no Cholesky factor.
        let own = self.inertia().symmetric_eigen();
        let mut root = own.eigenvectors;
        for (mut column, value) in root.column_iter_mut().zip(&own.eigenvalues) {
            column *= value.max(0.0).sqrt();
        }
        for (axis, row) in rows.chunks_exact_mut(6).enumerate() {
            let direction = axes.row(axis).transpose();
            let spin = root.tr_mul(&arm.cross(&direction));
            for k in 0..3 {
                row[k] = h * self.inverse_mass[k].max(0.0).sqrt() * direction[k];
                row[3 + k] = h * spin[k];
            }
        }
    }

    /// Largest inverse mass, 1/kg. Of a body that only turns, a bound of that at `point` (m).
    pub(crate) fn lightness(&self, point: &Vector3<f64>) -> f64 {
        let largest = self.inverse_mass.iter().copied().fold(0.0, f64::max);
        if largest > 0.0 {
            return largest;
        }
        self.inertia().trace().max(0.0) * (point - Vector3::from(self.center)).norm_squared()
    }

    /// Velocity (m/s) and angular velocity (rad/s) at the end of the computed step, with what
    /// supports do.
    pub(crate) fn after(&self, h: f64) -> [Vector3<f64>; 2] {
        let back = 1.0 / (self.weight * h);
        [
            Vector3::from(self.velocity) + back * self.displacement,
            Vector3::from(self.angular_velocity) + back * self.turn,
        ]
    }

    /// Energy that the computed step adds, with that in the field of the acceleration and without
    /// what moving supports supply, and the kinetic energies before and after it together, J. A
    /// body that a share of a torque turns counts with as much more inertia.
    pub(crate) fn gain(&self, share: f64, h: f64) -> [f64; 2] {
        let (before, pull) = (Vector3::from(self.velocity), Vector3::from(self.acceleration));
        let [after, turning] = self.after(h);
        let way = h * before + self.displacement;
        let (mut gained, mut moving) = (0.0, 0.0);
        for k in 0..3 {
            let mass = if self.inverse_mass[k] > 0.0 { 1.0 / self.inverse_mass[k] } else { 0.0 };
            gained += mass * (0.5 * (after[k] * after[k] - before[k] * before[k]) - pull[k] * way[k]);
            moving += 0.5 * mass * (after[k] * after[k] + before[k] * before[k]);
        }
        // Where an axis is locked there is no inertia.
        let own = self.inertia().symmetric_eigen();
        for (axis, light) in own.eigenvectors.column_iter().zip(&own.eigenvalues) {
            let inertia = if *light > 0.0 { 1.0 / (share * light) } else { 0.0 };
            let [begun, ended] =
                [Vector3::from(self.angular_velocity), turning].map(|turn| axis.dot(&turn).powi(2));
            gained += 0.5 * inertia * (ended - begun);
            moving += 0.5 * inertia * (ended + begun);
        }
        for support in self.supports.iter().filter(|support| support.other.is_none()) {
            let along = Vector3::from(support.normal).dot(&Vector3::from(support.velocity));
            gained -= h * support.force * along;
        }
        [gained, moving]
    }

    /// Mass, kg. Zero of a body that only turns.
    pub(crate) fn mass(&self) -> f64 {
        let light = self.inverse_mass.iter().copied().fold(0.0, f64::max);
        if light > 0.0 { 1.0 / light } else { 0.0 }
    }

    /// Change of the angular velocity by a torque (N m, world axes) over a step, rad/s.
    pub(crate) fn spun(&self, torque: &Vector3<f64>, h: f64) -> Vector3<f64> {
        h * (self.inertia() * torque)
    }

    /// Largest inverse inertia about an axis, 1/(kg m^2).
    pub(crate) fn turns_easily(&self) -> f64 {
        self.inertia().symmetric_eigenvalues().max().max(0.0)
    }

    /// Forgets what the last step has set.
    pub(crate) fn forget(&mut self) {
        self.begin();
        self.supports.iter_mut().for_each(|support| support.force = 0.0);
    }

    /// Forgets what the last step has set, but not the forces of the supports.
    pub(crate) fn begin(&mut self) {
        (self.force, self.torque, self.weight) = ([0.0; 3], [0.0; 3], 1.0);
        self.is_held = false;
        (self.displacement, self.turn) = (Vector3::zeros(), Vector3::zeros());
    }
}

/// An obstacle where forces of the step have moved it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pushed<'a> {
    pub(crate) shape: &'a dyn ObstacleShape,
    pub(crate) by: Option<&'a Rigid>,
    pub(crate) h: f64,
}

impl ObstacleShape for Pushed<'_> {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let Some(rigid) = self.by else { return self.shape.at(point) };
        let found = self.shape.at(&rigid.pull_back(point, self.h));
        SurfacePoint { normal: UnitQuaternion::from_scaled_axis(rigid.turn) * found.normal, ..found }
    }
}

impl Pushed<'_> {
    /// Displacement of the surface at a point by forces of the step, m.
    pub(crate) fn displacement(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.by.map_or_else(Vector3::zeros, |rigid| point - rigid.pull_back(point, self.h))
    }
}
