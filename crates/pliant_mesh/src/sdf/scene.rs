//! Bodies that a RON file describes as a few rounded parts.

use nalgebra::{Rotation3, Vector3};
use serde::Deserialize;

use super::{
    SignedDistance,
    shapes::{ellipsoid, round_cone, smooth_union, sphere},
};
use crate::{MeshError, Place};

/// Largest number of parts, and of points of a limb.
const MAX_PARTS: usize = 1000;
/// Number of straight pieces between two points of a limb's curve.
const PIECES: usize = 6;

/// Body made of rounded parts with smooth transitions, read from a RON text.
///
/// Lengths are in m, and y is up. The parts are joined one after another. Each part may have a
/// fillet to the parts before it and a mirror image across the plane x = 0, and may be carved out
/// instead of added. The part of the body below the floor is cut off.
///
/// | Field | Meaning | Default |
/// | --- | --- | --- |
/// | `name` | name of the body | |
/// | `floor` | `Some(height)`: everything below is cut off | `None` |
/// | `parts` | list of parts | |
/// | part: `name` | name for the reader and for errors | |
/// | part: `shape` | one of the shapes below | |
/// | part: `mirror` | whether a mirror image is added across x = 0 | `false` |
/// | part: `blend` | width of the fillet | 0: a sharp seam |
/// | part: `carve` | whether the part is removed instead of added | `false` |
///
/// | Shape | Fields |
/// | --- | --- |
/// | `Sphere` | `center`, `radius` |
/// | `Ellipsoid` | `center`, `radii`, `turn`: degrees about x, then y, then z, default none |
/// | `Limb` | `path`: points on a smooth curve (Catmull and Rom), `radii`: one per point |
///
/// ```
/// use pliant_mesh::sdf::{Scene, SignedDistance};
///
/// let snowman = Scene::from_ron(
///     "(name: \"snowman\", floor: Some(0.0), parts: [
///         (name: \"belly\", shape: Sphere(center: (0, 0.3, 0), radius: 0.35)),
///         (name: \"head\", shape: Sphere(center: (0, 0.8, 0), radius: 0.2), blend: 0.05),
///         (name: \"arm\", shape: Limb(path: [(0.3, 0.4, 0), (0.6, 0.6, 0)], radii: [0.05, 0.04]), mirror: true),
///     ])",
/// )?;
/// assert!(snowman.distance([0.0, 0.3, 0.0]) < 0.0);
/// assert_eq!(snowman.distance([-0.6, 0.6, 0.0]), snowman.distance([0.6, 0.6, 0.0]));
/// # Ok::<(), pliant_mesh::MeshError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Scene {
    name: String,
    floor: Option<f64>,
    parts: Vec<ScenePart>,
}

/// Part, or its mirror image, in the form that the distance function uses.
#[derive(Clone, Debug)]
struct ScenePart {
    form: Form,
    mirrored: bool,
    blend: f64,
    carve: bool,
    /// Center of a ball that contains the part. `radius` is the radius of this ball.
    center: Vector3<f64>,
    radius: f64,
}

#[derive(Clone, Debug)]
enum Form {
    Sphere,
    Ellipsoid { radii: Vector3<f64>, from_world: Rotation3<f64> },
    Limb(Vec<Piece>),
}

/// Straight piece of a limb.
#[derive(Clone, Debug)]
struct Piece {
    ends: [Vector3<f64>; 2],
    radii: [f64; 2],
    /// Center of a ball that contains the piece. `reach` is the radius of this ball.
    center: Vector3<f64>,
    reach: f64,
}

/// Contents of the RON text.
#[derive(Deserialize)]
#[serde(rename = "Scene", deny_unknown_fields)]
struct SceneText {
    name: String,
    #[serde(default)]
    floor: Option<f64>,
    parts: Vec<PartText>,
}

#[derive(Deserialize)]
#[serde(rename = "Part", deny_unknown_fields)]
struct PartText {
    name: String,
    shape: ShapeText,
    #[serde(default)]
    mirror: bool,
    #[serde(default)]
    blend: f64,
    #[serde(default)]
    carve: bool,
}

#[derive(Deserialize)]
#[serde(rename = "Shape", deny_unknown_fields)]
enum ShapeText {
    Sphere {
        center: [f64; 3],
        radius: f64,
    },
    Ellipsoid {
        center: [f64; 3],
        radii: [f64; 3],
        #[serde(default)]
        turn: [f64; 3],
    },
    Limb {
        path: Vec<[f64; 3]>,
        radii: Vec<f64>,
    },
}

impl Scene {
    /// Parses a description.
    ///
    /// # Errors
    /// Returns [`MeshError::Parse`] with the line where the text is not a valid description,
    /// [`MeshError::Empty`] without parts, and [`MeshError::Part`] when a number of a part is out
    /// of range.
    pub fn from_ron(text: &str) -> Result<Self, MeshError> {
        let scene: SceneText = ron::from_str(text).map_err(|error| MeshError::Parse {
            format: "RON",
            place: Place::Line(error.span.start.line),
            expected: "the description of a body".into(),
            found: error.code.to_string(),
        })?;
        if scene.parts.iter().all(|p| p.carve) {
            return Err(MeshError::Empty { what: "part that is not carved" });
        }
        if scene.parts.len() > MAX_PARTS {
            return Err(MeshError::parameter("parts", format!("at most {MAX_PARTS}"), scene.parts.len()));
        }
        if let Some(floor) = scene.floor.filter(|f| !f.is_finite()) {
            return Err(MeshError::parameter("floor", "a finite height in m", floor));
        }
        let mut parts = Vec::new();
        for text in scene.parts {
            let part = text.part()?;
            if text.mirror {
                parts.push(ScenePart { mirrored: true, ..part.clone() });
            }
            parts.push(part);
        }
        Ok(Self { name: scene.name, floor: scene.floor, parts })
    }

    /// Returns the name of the body.
    pub fn name(&self) -> &str {
        &self.name
    }
}

impl PartText {
    fn part(&self) -> Result<ScenePart, MeshError> {
        let wrong = |expected: &str, found: f64| MeshError::Part {
            part: self.name.clone(),
            expected: expected.to_owned(),
            found,
        };
        let finite = |numbers: &[f64]| match numbers.iter().find(|x| !x.is_finite()) {
            Some(&x) => Err(wrong("finite coordinates and angles", x)),
            None => Ok(()),
        };
        let positive = |radii: &[f64]| match radii.iter().find(|r| !(r.is_finite() && **r > 0.0)) {
            Some(&r) => Err(wrong("positive radii in m", r)),
            None => Ok(()),
        };
        if !(self.blend.is_finite() && self.blend >= 0.0) {
            return Err(wrong("a blend of 0 m or more", self.blend));
        }
        let (form, center, radius) = match &self.shape {
            ShapeText::Sphere { center, radius } => {
                finite(center)?;
                positive(&[*radius])?;
                (Form::Sphere, Vector3::from(*center), *radius)
            }
            ShapeText::Ellipsoid { center, radii, turn } => {
                finite(center)?;
                finite(turn)?;
                positive(radii)?;
                let [x, y, z] = turn.map(f64::to_radians);
                let from_world = Rotation3::from_euler_angles(x, y, z).inverse();
                let radii = Vector3::from(*radii);
                (Form::Ellipsoid { radii, from_world }, Vector3::from(*center), radii.max())
            }
            ShapeText::Limb { path, radii } => {
                finite(path.as_flattened())?;
                positive(radii)?;
                if path.len() < 2 || path.len() > MAX_PARTS {
                    return Err(wrong("a path of 2 to 1000 points", path.len() as f64));
                }
                if path.len() != radii.len() {
                    return Err(wrong("one radius for each point of the path", radii.len() as f64));
                }
                let balls = curve(path, radii);
                let count = balls.len() as f64;
                let center = balls.iter().map(|b| b.0).sum::<Vector3<f64>>() / count;
                let radius = balls.iter().map(|b| (b.0 - center).norm() + b.1).fold(0.0, f64::max);
                let pieces = balls.windows(2).map(|w| Piece {
                    ends: [w[0].0, w[1].0],
                    radii: [w[0].1, w[1].1],
                    center: (w[0].0 + w[1].0) / 2.0,
                    reach: (w[0].0 - w[1].0).norm() / 2.0 + w[0].1.max(w[1].1),
                });
                (Form::Limb(pieces.collect()), center, radius)
            }
        };
        Ok(ScenePart { form, mirrored: false, blend: self.blend, carve: self.carve, center, radius })
    }
}

/// Returns balls along a smooth curve through the points (Catmull and Rom 1974).
///
/// The ends are extrapolated linearly. The balls are close enough together to look smooth.
fn curve(path: &[[f64; 3]], radii: &[f64]) -> Vec<(Vector3<f64>, f64)> {
    let balls: Vec<(Vector3<f64>, f64)> =
        path.iter().map(|&p| Vector3::from(p)).zip(radii.iter().copied()).collect();
    if balls.len() == 2 {
        return balls;
    }
    let last = balls.len() - 1;
    let at = |i: isize| {
        let beyond = |a: (Vector3<f64>, f64), b: (Vector3<f64>, f64)| (2.0 * a.0 - b.0, 2.0 * a.1 - b.1);
        match i {
            -1 => beyond(balls[0], balls[1]),
            i if i as usize > last => beyond(balls[last], balls[last - 1]),
            i => balls[i as usize],
        }
    };
    let mut fine = vec![balls[0]];
    for i in 0..last {
        let [a, b, c, d] = [-1, 0, 1, 2].map(|k| at(i as isize + k));
        // The curve may overshoot slightly below small radii, so its radii are clamped.
        let (low, high) = (b.1.min(c.1), b.1.max(c.1));
        for piece in 1..=PIECES {
            let t = piece as f64 / PIECES as f64;
            let weights = [
                ((2.0 - t) * t - 1.0) * t / 2.0,
                ((3.0 * t - 5.0) * t * t + 2.0) / 2.0,
                ((4.0 - 3.0 * t) * t + 1.0) * t / 2.0,
                (t - 1.0) * t * t / 2.0,
            ];
            let [wa, wb, wc, wd] = weights;
            let position = wa * a.0 + wb * b.0 + wc * c.0 + wd * d.0;
            fine.push((position, (wa * a.1 + wb * b.1 + wc * c.1 + wd * d.1).clamp(low, high)));
        }
    }
    fine
}

impl ScenePart {
    fn distance(&self, p: Vector3<f64>) -> f64 {
        match &self.form {
            Form::Sphere => sphere(p, self.center, self.radius),
            Form::Ellipsoid { radii, from_world } => ellipsoid(from_world * (p - self.center), *radii),
            Form::Limb(pieces) => pieces.iter().fold(f64::INFINITY, |nearest, piece| {
                // The bounding ball skips most pieces, which are too far away to matter.
                if sphere(p, piece.center, piece.reach) >= nearest {
                    nearest
                } else {
                    nearest.min(round_cone(p, piece.ends, piece.radii))
                }
            }),
        }
    }
}

impl SignedDistance for Scene {
    fn distance(&self, p: [f64; 3]) -> f64 {
        let p = Vector3::from(p);
        let mirrored = Vector3::new(-p.x, p.y, p.z);
        let mut distance = f64::INFINITY;
        for part in &self.parts {
            let p = if part.mirrored { mirrored } else { p };
            // The bounding ball skips most parts, which are too far away to matter.
            let at_least = sphere(p, part.center, part.radius);
            if at_least - part.blend >= if part.carve { -distance } else { distance } {
                continue;
            }
            let other = part.distance(p);
            distance = if part.carve {
                -smooth_union(-distance, other, part.blend)
            } else {
                smooth_union(distance, other, part.blend)
            };
        }
        self.floor.map_or(distance, |floor| distance.max(floor - p.y))
    }

    fn bounds(&self) -> [[f64; 3]; 2] {
        let mut low = Vector3::repeat(f64::INFINITY);
        let mut high = Vector3::repeat(f64::NEG_INFINITY);
        // A smooth union may exceed its parts by up to a quarter of the blend.
        let mut fuller = 0.0;
        for part in self.parts.iter().filter(|p| !p.carve) {
            fuller += part.blend / 4.0;
            let mut center = part.center;
            if part.mirrored {
                center.x = -center.x;
            }
            low = low.inf(&center.add_scalar(-part.radius));
            high = high.sup(&center.add_scalar(part.radius));
        }
        low.add_scalar_mut(-fuller);
        high.add_scalar_mut(fuller);
        if let Some(floor) = self.floor {
            low.y = low.y.max(floor);
        }
        [low.into(), high.into()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{StuffOptions, stuff};

    const PIP: &str = include_str!("../../../../assets/pip.ron");

    fn message(text: &str) -> String {
        Scene::from_ron(text).unwrap_err().to_string()
    }

    #[test]
    fn errors_name_the_line_or_the_part() {
        let scene = |part: &str| format!("(name: \"x\", parts: [\n(name: \"ear\", {part})])");
        let sphere = |radius: &str| scene(&format!("shape: Sphere(center: (0, 0, 0), radius: {radius})"));
        assert!(Scene::from_ron(&sphere("0.1")).is_ok());
        assert_eq!(message(&sphere("-1")), "part \"ear\": expected positive radii in m, found -1");
        assert!(message(&sphere("NaN")).contains("positive radii"));
        assert!(
            message(&scene("shape: Sphere(center: (0, inf, 0), radius: 1)")).contains("finite coordinates")
        );
        assert!(
            message(&scene("shape: Sphere(center: (0, 0, 0), radius: 1), blend: -2"))
                .contains("blend of 0 m")
        );
        assert!(message(&scene("shape: Cube(side: 1)")).contains("RON, line 2"));
        assert!(message(&scene("shape: Sphere(center: (0, 0, 0), radius: 1), color: 3")).contains("color"));
        let limb = |path: &str| scene(&format!("shape: Limb(path: {path}, radii: [0.1])"));
        assert!(message(&limb("[(0, 0, 0)]")).contains("a path of 2 to 1000 points, found 1"));
        assert!(
            message(&limb("[(0, 0, 0), (1, 0, 0)]"))
                .contains("one radius for each point of the path, found 1")
        );
        assert!(message("").contains("RON, line 1"));
        assert!(message("(name: \"nothing\", parts: [])").contains("at least one part"));
    }

    #[test]
    fn the_field_changes_by_at_most_a_meter_a_meter() {
        let pip = Scene::from_ron(PIP).unwrap();
        let x = |n: u32, a: f64| (f64::from(n) * a).fract();
        for n in 1..4000 {
            let p = Vector3::new(x(n, 0.819_172_513), x(n, 0.671_043_606), x(n, 0.549_700_478)) * 0.6;
            let p = p - Vector3::new(0.3, 0.1, 0.3);
            let step = Vector3::new(x(n, 0.754_877_666), x(n, 0.569_840_291), x(n, 0.381_966_011));
            let step = step.add_scalar(-0.5) * 0.02;
            let change = (pip.distance((p + step).into()) - pip.distance(p.into())).abs();
            assert!(change <= step.norm() + 1e-10, "{change} over {} at {p:?}", step.norm());
        }
    }

    #[test]
    fn pip_stands_on_flat_feet_and_is_about_a_foot_tall() {
        let pip = Scene::from_ron(PIP).unwrap();
        let target = 6000;
        let mesh = stuff(&pip, &StuffOptions::with_target(target), &mut |_| ()).unwrap();
        mesh.check().unwrap();
        assert!(mesh.tets.len().abs_diff(target) <= target / 20);
        let quality = mesh.quality();
        assert!(quality.min_dihedral_deg > 10.7 && quality.max_dihedral_deg < 164.8, "{quality:?}");
        let (surface, _) = mesh.boundary();
        assert_eq!(surface.closed().unwrap().euler_characteristic(), 2, "one piece without handles");
        let [low, high] = surface.bounds();
        assert!(low[1].abs() < 1e-9, "stands at {}", low[1]);
        assert!((0.27..0.33).contains(&high[1]), "reaches to {}", high[1]);
        let soles = surface.positions.iter().filter(|p| p[1] < 1e-9).count();
        assert!(soles > 20, "{soles} vertices on the floor");
    }
}
