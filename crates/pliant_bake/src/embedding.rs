//! Locates points in the tetrahedra with a uniform grid over their bounding boxes.

use crate::fem::FeMesh;
use pliant_modal::tetrahedron::{dot, sub};

/// Nearest point of an element to a query point.
///
/// `barycentric` holds the coordinates of the nearest point. `offset` is the vector from the
/// nearest point to the query point, m, and is zero inside the element.
#[derive(Clone, Copy, Debug)]
pub(crate) struct EmbeddedPoint {
    pub(crate) element: usize,
    pub(crate) barycentric: [f64; 4],
    pub(crate) offset: [f64; 3],
}

impl EmbeddedPoint {
    /// Returns the distance from the element, m.
    pub(crate) fn distance(&self) -> f64 {
        dot(self.offset, self.offset).sqrt()
    }
}

/// Finds the element that contains a point, or the nearest element.
#[derive(Debug)]
pub(crate) struct Locator<'a> {
    mesh: &'a FeMesh,
    low: [f64; 3],
    cell: f64,
    counts: [usize; 3],
    /// Start of each grid cell's list in `elements`.
    offsets: Vec<usize>,
    elements: Vec<u32>,
}

impl<'a> Locator<'a> {
    pub(crate) fn new(mesh: &'a FeMesh) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in &mesh.nodes {
            for k in 0..3 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        let extent = [0, 1, 2].map(|k| high[k] - low[k]);
        let count = mesh.affine.len().max(1) as f64;
        // A cell has about four times the mean volume of an element. No axis has more than 128
        // cells.
        let volume: f64 = extent.iter().product();
        let cell = (4.0 * volume / count).cbrt().max(extent.iter().fold(0.0, |a: f64, &b| a.max(b)) / 128.0);
        let counts = extent.map(|e| ((e / cell).ceil() as usize).max(1));
        let mut out = Self { mesh, low, cell, counts, offsets: Vec::new(), elements: Vec::new() };
        let cells = counts.iter().product::<usize>();
        let mut lists: Vec<Vec<u32>> = vec![Vec::new(); cells];
        for (e, nodes) in mesh.elements().enumerate() {
            let (mut from, mut to) = ([usize::MAX; 3], [0; 3]);
            for &n in &nodes[..4] {
                let c = out.cell_of(mesh.nodes[n as usize]);
                for k in 0..3 {
                    from[k] = from[k].min(c[k]);
                    to[k] = to[k].max(c[k]);
                }
            }
            for x in from[0]..=to[0] {
                for y in from[1]..=to[1] {
                    for z in from[2]..=to[2] {
                        lists[(x * counts[1] + y) * counts[2] + z].push(e as u32);
                    }
                }
            }
        }
        out.offsets.push(0);
        for list in lists {
            out.elements.extend(list);
            out.offsets.push(out.elements.len());
        }
        out
    }

    fn cell_of(&self, p: [f64; 3]) -> [usize; 3] {
        [0, 1, 2].map(|k| (((p[k] - self.low[k]) / self.cell).max(0.0) as usize).min(self.counts[k] - 1))
    }

    /// Returns the nearest place. Returns `None` only for a mesh without elements.
    pub(crate) fn find(&self, p: [f64; 3]) -> Option<EmbeddedPoint> {
        let center = self.cell_of(p);
        let mut best: Option<EmbeddedPoint> = None;
        let furthest = self.counts.iter().copied().max().unwrap_or(0);
        for ring in 0..=furthest {
            if let Some(place) = &best {
                // Every element that only this ring or a later ring contains is at least `reach`
                // away from the point.
                let reach = (ring as f64 - 1.0) * self.cell;
                if place.distance() <= reach.max(0.0) {
                    break;
                }
            }
            self.visit_ring(center, ring, &mut |e| {
                let place = self.nearest_in(e as usize, p);
                if best.as_ref().is_none_or(|b| place.distance() < b.distance()) {
                    best = Some(place);
                }
            });
        }
        best
    }

    fn visit_ring(&self, center: [usize; 3], ring: usize, visit: &mut dyn FnMut(u32)) {
        let range = |k: usize| center[k].saturating_sub(ring)..=(center[k] + ring).min(self.counts[k] - 1);
        for x in range(0) {
            for y in range(1) {
                for z in range(2) {
                    let away = x.abs_diff(center[0]).max(y.abs_diff(center[1])).max(z.abs_diff(center[2]));
                    if away == ring {
                        let c = (x * self.counts[1] + y) * self.counts[2] + z;
                        self.elements[self.offsets[c]..self.offsets[c + 1]].iter().for_each(|&e| visit(e));
                    }
                }
            }
        }
    }

    fn corners(&self, element: usize) -> [[f64; 3]; 4] {
        let per = self.mesh.element.node_count();
        let nodes = &self.mesh.connectivity[element * per..][..4];
        [0, 1, 2, 3].map(|a| self.mesh.nodes[nodes[a] as usize])
    }

    fn barycentric(&self, element: usize, p: [f64; 3]) -> [f64; 4] {
        let corners = self.corners(element);
        let g = &self.mesh.affine[element].gradients;
        // Each coordinate is measured from a corner where it vanishes. This avoids cancellation for
        // meshes far from the origin.
        [0, 1, 2, 3].map(|a| dot(g[a], sub(p, corners[(a + 1) % 4])))
    }

    fn nearest_in(&self, element: usize, p: [f64; 3]) -> EmbeddedPoint {
        let l = self.barycentric(element, p);
        if l.iter().all(|&x| x >= 0.0) {
            return EmbeddedPoint { element, barycentric: l, offset: [0.0; 3] };
        }
        let corners = self.corners(element);
        let mut best = (f64::INFINITY, corners[0]);
        for face in [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]] {
            let q = nearest_on_triangle(face.map(|a| corners[a]), p);
            let d = sub(p, q);
            if dot(d, d) < best.0 {
                best = (dot(d, d), q);
            }
        }
        EmbeddedPoint { element, barycentric: self.barycentric(element, best.1), offset: sub(p, best.1) }
    }
}

/// Returns the nearest point of a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
fn nearest_on_triangle([a, b, c]: [[f64; 3]; 3], p: [f64; 3]) -> [f64; 3] {
    let at = |u: f64, v: f64| [0, 1, 2].map(|k| a[k] + u * (b[k] - a[k]) + v * (c[k] - a[k]));
    let (ab, ac, ap) = (sub(b, a), sub(c, a), sub(p, a));
    let (d1, d2) = (dot(ab, ap), dot(ac, ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let bp = sub(p, b);
    let (d3, d4) = (dot(ab, bp), dot(ac, bp));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return at(d1 / (d1 - d3), 0.0);
    }
    let cp = sub(p, c);
    let (d5, d6) = (dot(ab, cp), dot(ac, cp));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return at(0.0, d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        let w = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return at(1.0 - w, w);
    }
    let sum = va + vb + vc;
    at(vb / sum, vc / sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use pliant_modal::Element;

    #[test]
    fn finds_points_inside_and_the_nearest_place_outside() {
        let mesh = pliant_mesh::shapes::bar([6, 3, 2], [3.0, 1.0, 1.0]).unwrap();
        let fe = FeMesh::new(&mesh, Element::Tet4);
        let locator = Locator::new(&fe);
        for p in [[0.1, 0.2, 0.3], [2.9, 0.9, 0.05], [1.5, 0.5, 0.5], [0.0, 0.0, 0.0], [3.0, 1.0, 1.0]] {
            let place = locator.find(p).unwrap();
            assert!(place.distance() < 1e-12, "{p:?} {place:?}");
            let corners = locator.corners(place.element);
            for k in 0..3 {
                let x: f64 = (0..4).map(|a| place.barycentric[a] * corners[a][k]).sum();
                assert!((x - p[k]).abs() < 1e-12);
            }
        }
        for (p, distance) in [([-0.5, 0.5, 0.5], 0.5), ([3.3, 1.4, 0.5], 0.5), ([1.0, 0.5, 4.0], 3.0)] {
            let place = locator.find(p).unwrap();
            assert!((place.distance() - distance).abs() < 1e-12, "{p:?} {}", place.distance());
        }
    }
}
