//! Materials that vary within a body: regions between half-spaces, and values painted on a surface.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use pliant_mesh::{
    MeshError, Surface, SurfaceLocator,
    io::{self, Input},
};

use crate::fem::FeMesh;
use crate::{Anchor, AnchorSyntax, BakeConfig, BakeError};

/// Part of a body that is stiffer, softer, heavier or lighter than the rest, such as a bone in
/// flesh.
///
/// An element belongs to the region when its centroid lies in all of its half-spaces. Where regions
/// overlap, their factors multiply. All parts have the same Poisson ratio.
///
/// ```
/// let beak: pliant_bake::Region = "x>0.2 & y<0.1: stiffness 50, density 1.5".parse()?;
/// assert_eq!((beak.within.len(), beak.stiffness, beak.density), (2, 50.0, 1.5));
/// # Ok::<(), pliant_bake::RegionSyntax>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Region {
    /// Half-spaces whose common part is the region. An empty list is the whole body.
    pub within: Vec<Anchor>,
    /// Factor of Young's modulus, 1e-6 to 1e6. Default: 1.
    pub stiffness: f64,
    /// Factor of the density, 1e-3 to 1e3. Default: 1.
    pub density: f64,
}

impl Default for Region {
    fn default() -> Self {
        Self { within: Vec::new(), stiffness: 1.0, density: 1.0 }
    }
}

impl fmt::Display for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let within: Vec<String> = self.within.iter().map(ToString::to_string).collect();
        write!(f, "{}: stiffness {}, density {}", within.join(" & "), self.stiffness, self.density)
    }
}

/// Error for a text that is not a region.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "region `{text}`: expected half-spaces and factors, such as `x>0.2 & y<0.1: stiffness 50, density 1.5`; {problem}"
)]
pub struct RegionSyntax {
    /// Received text.
    pub text: String,
    /// Description of the problem.
    pub problem: String,
}

impl FromStr for Region {
    type Err = RegionSyntax;

    /// Parses `HALF-SPACE & HALF-SPACE ...: stiffness FACTOR, density FACTOR`. Either factor may be
    /// left out.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = |problem: String| RegionSyntax { text: text.to_owned(), problem };
        let (places, factors) =
            text.split_once(':').ok_or_else(|| wrong("no colon follows the half-spaces".to_owned()))?;
        let places = places.split('&').map(str::parse);
        let within = places.collect::<Result<Vec<Anchor>, AnchorSyntax>>().map_err(|e| wrong(e.problem))?;
        let mut region = Self { within, ..Self::default() };
        for factor in factors.split(',').map(str::trim) {
            let (name, number) =
                factor.split_once(' ').ok_or_else(|| wrong(format!("`{factor}` is no name and number")))?;
            let number = number.trim();
            let value = number.parse().map_err(|_| wrong(format!("`{number}` is no number")))?;
            match name {
                "stiffness" => region.stiffness = value,
                "density" => region.density = value,
                other => return Err(wrong(format!("`{other}` is neither stiffness nor density"))),
            }
        }
        Ok(region)
    }
}

/// Values at the vertices of a surface, as they are painted in a modeler.
///
/// A point of the body has the value of the closest point of the surface. An empty list means that
/// nothing is painted.
#[derive(Clone, Debug, PartialEq)]
pub struct Paint {
    /// Surface that the values belong to. It need not be closed.
    pub surface: Surface,
    /// Factor of Young's modulus for each vertex, 1e-6 to 1e6.
    pub stiffness: Vec<f64>,
    /// Factor of the density for each vertex, 1e-3 to 1e3.
    pub density: Vec<f64>,
    /// Weight of the anchor for each vertex. Nodes with a weight above 1/2 are fixed.
    pub anchored: Vec<f64>,
}

impl Paint {
    /// Returns a painting of a surface on which nothing is painted yet.
    pub fn new(surface: Surface) -> Self {
        Self { surface, stiffness: Vec::new(), density: Vec::new(), anchored: Vec::new() }
    }

    /// The attributes of a glTF file that are read: of stiffness, density and anchor.
    pub const ATTRIBUTES: [&str; 3] = ["_STIFFNESS", "_DENSITY", "_ANCHOR"];

    /// Returns a painting of a surface with numbers at its vertices, in the order of
    /// [`Paint::ATTRIBUTES`]. `None` if nothing is painted. A vertex whose number is NaN is not
    /// painted: its factors are 1, and it is not fixed.
    pub fn of_values(surface: &Surface, values: [Vec<f64>; 3]) -> Option<Self> {
        if values.iter().all(Vec::is_empty) {
            return None;
        }
        let or = |unpainted: f64, mut values: Vec<f64>| {
            values.iter_mut().filter(|value| value.is_nan()).for_each(|value| *value = unpainted);
            values
        };
        let [stiffness, density, anchored] = values;
        Some(Self {
            surface: surface.clone(),
            stiffness: or(1.0, stiffness),
            density: or(1.0, density),
            anchored: or(0.0, anchored),
        })
    }

    /// Reads a file as [`io::read`] does, and what is painted on its surface.
    ///
    /// # Errors
    /// Returns the errors of [`io::read`].
    pub fn read(path: impl AsRef<Path>) -> Result<(Input, Option<Self>), MeshError> {
        let path = path.as_ref();
        match io::read_painted(path, &Self::ATTRIBUTES) {
            Ok(read) => {
                let (surface, paint) = Self::with_surface(read);
                Ok((Input::Surface(surface), paint))
            }
            Err(MeshError::UnknownFormat { .. }) => Ok((io::read(path)?, None)),
            Err(error) => Err(error),
        }
    }

    /// Reads a surface from the bytes of a file ([`io::parse_painted`]), and what is painted on it.
    ///
    /// # Errors
    /// Returns the errors of [`io::parse_painted`].
    pub fn parse(path: impl AsRef<Path>, bytes: &[u8]) -> Result<(Surface, Option<Self>), MeshError> {
        io::parse_painted(path, bytes, &Self::ATTRIBUTES).map(Self::with_surface)
    }

    fn with_surface((surface, values): (Surface, Vec<Vec<f32>>)) -> (Surface, Option<Self>) {
        let mut values = values.into_iter().map(|list| list.into_iter().map(f64::from).collect());
        let values = std::array::from_fn(|_| values.next().unwrap_or_default());
        let paint = Self::of_values(&surface, values);
        (surface, paint)
    }

    /// Checks the surface and the painted values. A bake does so too.
    ///
    /// # Errors
    /// Returns [`BakeError::Paint`] for a bad surface, and [`BakeError::Parameter`] for a list of
    /// another length and for a value out of range.
    pub fn check(&self) -> Result<(), BakeError> {
        self.surface.check().map_err(BakeError::Paint)?;
        let vertices = self.surface.positions.len();
        let lengths = [&self.stiffness, &self.density, &self.anchored].map(Vec::len);
        let fits = |n: f64| n == 0.0 || n == vertices as f64;
        let lengths = lengths.into_iter().map(|n| n as f64);
        each("painted values", "one for each vertex of the painted surface, or none", &fits, lengths)?;
        each("painted stiffness", "1e-6 to 1e6", &is_stiffness, self.stiffness.iter().copied())?;
        each("painted density", "1e-3 to 1e3", &is_density, self.density.iter().copied())?;
        each("painted anchor", "a finite weight", &f64::is_finite, self.anchored.iter().copied())
    }

    /// Returns whether some vertex has a weight of the anchor above 1/2.
    pub fn anchors(&self) -> bool {
        self.anchored.iter().any(|&weight| weight > ANCHORED_FROM)
    }
}

/// Weight of a painted anchor above which a node is fixed.
const ANCHORED_FROM: f64 = 0.5;

/// Factors of Young's modulus.
const STIFFNESS: std::ops::RangeInclusive<f64> = 1e-6..=1e6;
/// Factors of the density.
const DENSITY: std::ops::RangeInclusive<f64> = 1e-3..=1e3;

/// Refuses the first value that is not `ok`.
fn each(
    name: &'static str,
    expected: &'static str,
    ok: &dyn Fn(f64) -> bool,
    mut values: impl Iterator<Item = f64>,
) -> Result<(), BakeError> {
    values.find(|&x| !ok(x)).map_or(Ok(()), |got| Err(BakeError::Parameter { name, expected, got }))
}

/// Checks the factors of regions and painting.
pub(crate) fn check(config: &BakeConfig) -> Result<(), BakeError> {
    let regions = &config.regions;
    let count = regions.len() as f64;
    each("regions", "at most 64", &|n| n <= 64.0, std::iter::once(count))?;
    each("stiffness of a region", "1e-6 to 1e6", &is_stiffness, regions.iter().map(|r| r.stiffness))?;
    each("density of a region", "1e-3 to 1e3", &is_density, regions.iter().map(|r| r.density))?;
    config.paint.as_ref().map_or(Ok(()), Paint::check)
}

fn is_stiffness(factor: f64) -> bool {
    STIFFNESS.contains(&factor)
}

fn is_density(factor: f64) -> bool {
    DENSITY.contains(&factor)
}

/// Value of a list at a place of the painted surface.
fn at(paint: &Paint, values: &[f64], place: &pliant_mesh::ClosestPoint) -> f64 {
    let corners = paint.surface.triangles[place.triangle as usize];
    corners.iter().zip(place.weights).map(|(&vertex, weight)| weight * values[vertex as usize]).sum()
}

/// Returns for each node whether painting fixes it.
pub(crate) fn painted_nodes(fe: &FeMesh, paint: &Paint) -> Result<Vec<bool>, BakeError> {
    if paint.anchored.is_empty() {
        return Ok(vec![false; fe.nodes.len()]);
    }
    let locator = SurfaceLocator::new(&paint.surface).map_err(BakeError::Paint)?;
    let anchored = |&p: &[f64; 3]| at(paint, &paint.anchored, &locator.closest(p)) > ANCHORED_FROM;
    Ok(fe.nodes.iter().map(anchored).collect())
}

/// Sets the factors of stiffness and density of all elements.
pub(crate) fn vary(fe: &mut FeMesh, config: &BakeConfig) -> Result<(), BakeError> {
    let centroid = |fe: &FeMesh, element: usize| -> [f64; 3] {
        let per = fe.element.node_count();
        let corners = &fe.connectivity[element * per..][..4];
        std::array::from_fn(|k| corners.iter().map(|&n| fe.nodes[n as usize][k]).sum::<f64>() / 4.0)
    };
    for element in 0..fe.affine.len() {
        let p = centroid(fe, element);
        for region in config.regions.iter().filter(|r| r.within.iter().all(|half| half.holds(p))) {
            fe.stiffness[element] *= region.stiffness;
            fe.density[element] *= region.density;
        }
    }
    let Some(paint) = &config.paint else { return Ok(()) };
    if paint.stiffness.is_empty() && paint.density.is_empty() {
        return Ok(());
    }
    let locator = SurfaceLocator::new(&paint.surface).map_err(BakeError::Paint)?;
    for element in 0..fe.affine.len() {
        let place = locator.closest(centroid(fe, element));
        if !paint.stiffness.is_empty() {
            fe.stiffness[element] *= at(paint, &paint.stiffness, &place);
        }
        if !paint.density.is_empty() {
            fe.density[element] *= at(paint, &paint.density, &place);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_painted_in_a_file_is_read_with_its_surface() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/blender/bud.glb");
        let (input, paint) = Paint::read(path).unwrap();
        let Input::Surface(surface) = input else { panic!("expected a surface") };
        let paint = paint.unwrap();
        assert_eq!(paint.surface, surface);
        assert!(paint.anchors() && paint.anchored.iter().any(|&weight| weight < 0.5));
        assert_eq!(paint.stiffness.len(), surface.positions.len());
        assert!(paint.stiffness.iter().any(|&factor| factor > 1.5), "a stiff part");
        assert!(paint.stiffness.iter().all(|factor| STIFFNESS.contains(factor)));
        assert!(paint.density.is_empty(), "nothing of it is painted");
        assert!(paint.check().is_ok());
        // A new attribute of a modeler is 0 everywhere.
        let new = Paint { density: vec![0.0; surface.positions.len()], ..paint.clone() };
        let error = new.check().unwrap_err().to_string();
        assert!(error.contains("painted density") && error.contains('0'), "{error}");
        assert_eq!(Paint::parse(path, &std::fs::read(path).unwrap()).unwrap(), (surface, Some(paint)));
        // A scene has no surface to paint on.
        let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/bud.ron");
        assert!(matches!(Paint::read(scene), Ok((Input::Sdf(_), None))));
        assert!(Paint::read("nowhere.glb").is_err() && Paint::read("nowhere.ron").is_err());
    }

    #[test]
    fn a_region_is_read_as_it_is_written() {
        for text in ["x>0.2 & y<=0.1: stiffness 50, density 1.5", "z<1: stiffness 0.01, density 1"] {
            let region: Region = text.parse().unwrap();
            assert_eq!(region.to_string(), text);
        }
        let light: Region = " z < 1 :density 0.5".parse().unwrap();
        assert_eq!((light.stiffness, light.density), (1.0, 0.5));
    }

    #[test]
    fn what_is_no_region_is_refused_with_its_problem() {
        for (text, problem) in [
            ("x<1", "no colon"),
            ("w<1: stiffness 2", "`w` is no axis"),
            ("x<1: hardness 2", "`hardness` is neither"),
            ("x<1: stiffness", "no name and number"),
            ("x<1: stiffness soft", "`soft` is no number"),
            (": stiffness 2", "it is empty"),
        ] {
            let error = text.parse::<Region>().unwrap_err().to_string();
            assert!(error.contains(problem), "{text}: {error}");
        }
    }

    #[test]
    fn factors_out_of_range_are_refused() {
        let region = |stiffness, density| Region { stiffness, density, ..Region::default() };
        for bad in [region(0.0, 1.0), region(f64::NAN, 1.0), region(1.0, -1.0), region(1e7, 1.0)] {
            let config = BakeConfig { regions: vec![bad], ..BakeConfig::default() };
            assert!(matches!(config.check(), Err(BakeError::Parameter { .. })));
        }
        let surface = Surface {
            positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            triangles: vec![[0, 1, 2]],
            uvs: None,
        };
        let short = Paint { stiffness: vec![1.0; 2], ..Paint::new(surface.clone()) };
        let soft = Paint { stiffness: vec![0.0; 3], ..Paint::new(surface.clone()) };
        let nan = Paint { anchored: vec![f64::NAN; 3], ..Paint::new(surface) };
        for bad in [short, soft, nan] {
            let config = BakeConfig { paint: Some(bad), ..BakeConfig::default() };
            assert!(matches!(config.check(), Err(BakeError::Parameter { .. })));
        }
    }
}
