//! The rest surface of a body as something that other bodies touch.

mod build;

use nalgebra::Vector3;

/// Number of sites that carry one vertex.
const CARRIERS: usize = 4;

/// Largest number of sites that carry one place of the surface.
pub(crate) const MAX_CARRIERS: usize = 3 * CARRIERS;

/// Cosine of the angle between two triangles above which the surface is smooth between them.
pub(super) const SMOOTH: f64 = 0.7;

/// Cosine of the angle between two normals of a surface above which they belong to one side of a
/// groove.
pub(crate) const ALONG: f64 = 0.8;

/// Cosine of the angle between a normal of a triangle and the way from its nearest place to a point
/// above which the triangle lies below the point.
const BELOW: f64 = 0.9;

/// Largest cosine between the outward normals of a site and of a triangle that it may touch.
const FACING: f64 = -0.2;

/// A triangle of the rest surface.
#[derive(Debug)]
struct Facet {
    corners: [u32; 3],
    normal: Vector3<f64>,
    /// Normals of the smooth surface at the corners.
    smooth: [Vector3<f64>; 3],
    /// Whether a triangle at the corner has another smooth surface, and one beyond the edge from
    /// there to the next corner.
    sharp: [[bool; 2]; 3],
}

/// A box around triangles. A leaf has triangles from `first`, another node two children, the first
/// right behind it and the second at `first`.
#[derive(Debug)]
struct Node {
    low: Vector3<f64>,
    high: Vector3<f64>,
    /// A box around the normals of the triangles.
    normals: [Vector3<f64>; 2],
    first: u32,
    count: u32,
}

/// A node of the tree of sites. A leaf has no second child. The first follows right behind it.
#[derive(Debug)]
pub(crate) struct Cluster {
    /// The sites, as a range of [`SurfaceField::sites`].
    pub(crate) first: usize,
    pub(crate) end: usize,
    pub(crate) second: Option<usize>,
    /// How far the surface around the sites goes beyond their box, m.
    cover: f64,
}

impl Cluster {
    pub(crate) fn is_leaf(&self) -> bool {
        self.second.is_none()
    }
}

/// Where the sites of a bent body are, m, body axes, and boxes around them.
#[derive(Debug, Clone, Default)]
pub(crate) struct Cloud {
    pub(crate) sites: Vec<Vector3<f64>>,
    pub(crate) boxes: Vec<[Vector3<f64>; 2]>,
    /// The six numbers of all sites, one after another for each.
    pub(super) sixes: Vec<f64>,
}

impl Cloud {
    /// Largest way of a site from another shape of the same body, m.
    pub(crate) fn way(&self, from: &Self) -> f64 {
        if self.sites.len() != from.sites.len() {
            return f64::INFINITY;
        }
        let ways = self.sites.iter().zip(&from.sites).map(|(to, from)| (to - from).norm_squared());
        ways.fold(0.0, f64::max).sqrt()
    }
}

/// How far the sites of a body have gone in all looks so far, in body axes.
#[derive(Debug, Clone, Default)]
pub(crate) struct Bent {
    /// Sum of the largest ways, m.
    pub(crate) way: f64,
    /// Coordinates at the last look, and where the sites were, but for `slack` (m).
    pub(crate) q: Vec<f64>,
    pub(crate) cloud: Cloud,
    pub(crate) slack: f64,
    pub(crate) spare: Cloud,
}

/// Which triangles of a surface a search looks at.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Side {
    All,
    /// Those of the side of a groove that has this normal, where the point is in front of them.
    Along(Vector3<f64>),
    /// Those of another side of a groove, where they lie below the point.
    Beside(Vector3<f64>),
}

/// A place of the rest surface.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub(crate) struct Place {
    facet: u32,
    /// Weights of the corners, with the sum 1.
    weights: [f64; 3],
}

impl Place {
    /// Weights of the corners of the triangle.
    pub(crate) fn weights(&self) -> [f64; 3] {
        self.weights
    }
}

/// Sites that carry a place, with their weights.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Carriers {
    list: [(u32, f64); MAX_CARRIERS],
    count: usize,
}

impl Carriers {
    /// The first of some sites with their weights, without those of no weight.
    pub(crate) fn new(sites: impl Iterator<Item = (usize, f64)>) -> Self {
        let mut all = Self { list: [(0, 0.0); MAX_CARRIERS], count: 0 };
        sites.filter(|(_, weight)| *weight != 0.0).for_each(|(site, weight)| all.add(site as u32, weight));
        all
    }

    fn add(&mut self, site: u32, weight: f64) {
        if let Some(entry) = self.list[..self.count].iter_mut().find(|(known, _)| *known == site) {
            entry.1 += weight;
        } else if let Some(entry) = self.list.get_mut(self.count) {
            *entry = (site, weight);
            self.count += 1;
        }
    }

    /// The site with the largest weight.
    pub(crate) fn largest(&self) -> Option<usize> {
        self.iter().max_by(|a, b| a.1.total_cmp(&b.1)).map(|(site, _)| site)
    }

    /// Sites and weights.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (usize, f64)> + Clone + '_ {
        self.list[..self.count].iter().map(|(site, weight)| (*site as usize, *weight))
    }
}

/// The rest surface of a body, smooth where its triangles meet at small angles.
///
/// Between the vertices the smooth surface lies above the triangle by
/// `sum b_i n_i . (x_i - x) / 2` with the weights `b_i`, the corners `x_i` and their normals `n_i`,
/// which is exact for a surface of constant curvature. The displacement of a vertex is that of the
/// sites around it, weighted such that a linear field is exact (moving least squares).
#[derive(Debug)]
pub(crate) struct SurfaceField {
    vertices: Vec<Vector3<f64>>,
    facets: Vec<Facet>,
    nodes: Vec<Node>,
    /// The sites by clusters, and the tree of these.
    sites: Vec<u32>,
    clusters: Vec<Cluster>,
    /// A place near each site.
    places: Vec<Place>,
    /// Carriers of each vertex. Anchored vertices have none.
    carriers: Vec<Vec<(u32, f64)>>,
}

/// The closest point of a triangle to a point, as weights of its corners (Ericson, Real-Time
/// Collision Detection, 5.1.5).
pub(crate) fn closest_on_triangle([a, b, c]: [&Vector3<f64>; 3], p: &Vector3<f64>) -> [f64; 3] {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return [1.0, 0.0, 0.0];
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
    if d3 >= 0.0 && d4 <= d3 {
        return [0.0, 1.0, 0.0];
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        let v = d1 / (d1 - d3);
        return [1.0 - v, v, 0.0];
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
    if d6 >= 0.0 && d5 <= d6 {
        return [0.0, 0.0, 1.0];
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        let w = d2 / (d2 - d6);
        return [1.0 - w, 0.0, w];
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        let w = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return [0.0, 1.0 - w, w];
    }
    let denominator = 1.0 / (va + vb + vc);
    let (v, w) = (vb * denominator, vc * denominator);
    [1.0 - v - w, v, w]
}

impl Node {
    /// Whether no triangle of the node looks at a site with this outward normal.
    fn looks_away(&self, facing: &Vector3<f64>) -> bool {
        let [low, high] = &self.normals;
        facing.component_mul(low).inf(&facing.component_mul(high)).sum() > FACING
    }

    /// Smallest and largest product of a normal of the node with a direction, or beyond them.
    fn along(&self, direction: &Vector3<f64>) -> [f64; 2] {
        let [low, high] = self.normals.each_ref().map(|normal| direction.component_mul(normal));
        [low.inf(&high).sum(), low.sup(&high).sum()]
    }
}

impl SurfaceField {
    /// A place near a site.
    pub(crate) fn place_of(&self, site: usize) -> Option<Place> {
        self.places.get(site).copied().filter(|place| self.has(place))
    }

    /// The nodes of the tree of sites.
    pub(crate) fn clusters(&self) -> &[Cluster] {
        &self.clusters
    }

    /// The sites of a node.
    pub(crate) fn sites_of(&self, cluster: &Cluster) -> &[u32] {
        &self.sites[cluster.first..cluster.end]
    }

    /// Makes the boxes around the sites of a bent body.
    pub(crate) fn enclose(&self, cloud: &mut Cloud) {
        cloud.boxes.clear();
        cloud.boxes.resize(self.clusters.len(), [Vector3::zeros(); 2]);
        for (number, cluster) in self.clusters.iter().enumerate().rev() {
            cloud.boxes[number] = match cluster.second {
                Some(second) => {
                    let ([low, high], [a, b]) = (&cloud.boxes[number + 1], &cloud.boxes[second]);
                    [low.inf(a), high.sup(b)]
                }
                None => self.sites_of(cluster).iter().fold(
                    [Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)],
                    |[low, high], site| {
                        let at = &cloud.sites[*site as usize];
                        [low.inf(at), high.sup(at)]
                    },
                ),
            };
        }
    }

    /// How far a point (m, body axes) is at least from the surface of a bent body, m, or at most 0
    /// where it may touch it, and the nearest leaf of the tree of sites.
    pub(crate) fn away(&self, cloud: &Cloud, point: &Vector3<f64>) -> (f64, usize) {
        let away = |number: usize| {
            let [low, high] = &cloud.boxes[number];
            let over = (low - point).sup(&(point - high)).map(|x| x.max(0.0));
            over.norm() - self.clusters[number].cover
        };
        let (mut least, mut nearest) = (f64::INFINITY, 0);
        let mut stack = [(0, 0.0); 64];
        let mut depth = 0;
        if !self.clusters.is_empty() {
            (stack[0], depth) = ((0, away(0)), 1);
        }
        while depth > 0 && least > 0.0 {
            depth -= 1;
            let (number, distance) = stack[depth];
            if distance >= least {
                continue;
            }
            match self.clusters[number].second {
                None => (least, nearest) = (distance, number),
                Some(second) => {
                    let mut children = [number + 1, second].map(|child| (child, away(child)));
                    if children[0].1 < children[1].1 {
                        children.swap(0, 1);
                    }
                    for child in children {
                        if depth < stack.len() {
                            stack[depth] = child;
                            depth += 1;
                        }
                    }
                }
            }
        }
        (least, nearest)
    }

    /// The site of a leaf of the tree of sites that is nearest to a point (m, body axes) on a bent
    /// body.
    pub(crate) fn nearest_site(&self, cloud: &Cloud, leaf: usize, point: &Vector3<f64>) -> Option<usize> {
        let sites = self.sites_of(self.clusters.get(leaf)?).iter().map(|&site| site as usize);
        let distance = |site: &usize| (cloud.sites[*site] - point).norm_squared();
        sites.min_by(|a, b| distance(a).total_cmp(&distance(b)))
    }

    /// The place of the rest surface nearest to a point (m, body axes), no farther than `within`
    /// (m). Of all triangles only those count that look at a site with the outward normal `facing`.
    /// The search begins at the triangle of `hint`.
    pub(crate) fn closest(
        &self,
        point: &Vector3<f64>,
        facing: Option<&Vector3<f64>>,
        within: f64,
        hint: Option<&Place>,
    ) -> Option<Place> {
        match facing {
            Some(facing) => self.search(
                (point, within, hint),
                |node| node.looks_away(facing),
                |normal| facing.dot(normal) <= FACING,
                |_, _| true,
            ),
            None => self.search((point, within, hint), |_| false, |_| true, |_, _| true),
        }
    }

    /// As [`SurfaceField::closest`], of the triangles of one side.
    pub(crate) fn closest_of(
        &self,
        point: &Vector3<f64>,
        side: &Side,
        within: f64,
        hint: Option<&Place>,
    ) -> Option<Place> {
        match side {
            Side::All => self.closest(point, None, within, hint),
            Side::Along(of) => self.search(
                (point, within, hint),
                |node| node.along(of)[1] < ALONG,
                |normal| of.dot(normal) >= ALONG,
                |normal, way| normal.dot(way) > 0.0,
            ),
            Side::Beside(of) => self.search(
                (point, within, hint),
                |node| node.along(of)[0] >= ALONG,
                |normal| of.dot(normal) < ALONG,
                |normal, way| normal.dot(way) > BELOW * way.norm(),
            ),
        }
    }

    /// The nearest place of the triangles whose nodes and normals count and which lie in a way to
    /// the point that fits.
    fn search(
        &self,
        (point, within, hint): (&Vector3<f64>, f64, Option<&Place>),
        leaves_out: impl Fn(&Node) -> bool,
        counts: impl Fn(&Vector3<f64>) -> bool,
        fits: impl Fn(&Vector3<f64>, &Vector3<f64>) -> bool,
    ) -> Option<Place> {
        let mut least = within * within;
        let mut found = None;
        let look = |number: u32, least: &mut f64, found: &mut Option<Place>| {
            let facet = &self.facets[number as usize];
            if !counts(&facet.normal) {
                return;
            }
            let corners = facet.corners.map(|v| &self.vertices[v as usize]);
            // The plane is no farther than the triangle.
            let above = facet.normal.dot(&(point - corners[0]));
            if above * above > *least {
                return;
            }
            let weights = closest_on_triangle(corners, point);
            let near: Vector3<f64> = corners.iter().zip(weights).map(|(x, w)| **x * w).sum();
            let way = point - near;
            let distance = way.norm_squared();
            if distance < *least && fits(&facet.normal, &way) {
                *least = distance;
                *found = Some(Place { facet: number, weights });
            }
        };
        if let Some(hint) = hint {
            look(hint.facet, &mut least, &mut found);
        }
        let mut stack = [0u32; 64];
        let mut depth = usize::from(!self.nodes.is_empty());
        let away = |node: &Node| {
            let over = (node.low - point).sup(&(point - node.high)).map(|x| x.max(0.0));
            over.norm_squared()
        };
        while depth > 0 {
            depth -= 1;
            let index = stack[depth];
            let node = &self.nodes[index as usize];
            // Comparisons with no number are false, and such a point has no place.
            let near = away(node) < least;
            if !near || leaves_out(node) {
                continue;
            }
            if node.count == 0 {
                let mut children = [index + 1, node.first];
                if away(&self.nodes[children[0] as usize]) < away(&self.nodes[children[1] as usize]) {
                    children.swap(0, 1);
                }
                for child in children {
                    if depth < stack.len() {
                        stack[depth] = child;
                        depth += 1;
                    }
                }
                continue;
            }
            for number in node.first..node.first + node.count {
                look(number, &mut least, &mut found);
            }
        }
        found
    }

    /// Whether the surface has a place. One of another body's surface it may not have.
    pub(crate) fn has(&self, place: &Place) -> bool {
        (place.facet as usize) < self.facets.len()
    }

    /// The place of the same triangle that is nearest to a point (m, body axes), and its distance,
    /// m.
    pub(crate) fn on_same_triangle(&self, place: &Place, point: &Vector3<f64>) -> Option<(Place, f64)> {
        let facet = self.facets.get(place.facet as usize)?;
        let weights = closest_on_triangle(facet.corners.map(|v| &self.vertices[v as usize]), point);
        let place = Place { facet: place.facet, weights };
        Some((place, (point - self.rest(&place)).norm()))
    }

    /// Whether a place lies on an edge or at a corner where the surface is not smooth.
    pub(crate) fn is_sharp(&self, place: &Place) -> bool {
        let sharp = &self.facets[place.facet as usize].sharp;
        match place.weights.map(|weight| weight == 0.0) {
            [false, true, true] => sharp[0][0],
            [true, false, true] => sharp[1][0],
            [true, true, false] => sharp[2][0],
            [false, false, true] => sharp[0][1],
            [true, false, false] => sharp[1][1],
            [false, true, false] => sharp[2][1],
            _ => false,
        }
    }

    /// The corners of the triangle of a place, m, body axes.
    pub(crate) fn corners(&self, place: &Place) -> [&Vector3<f64>; 3] {
        self.facets[place.facet as usize].corners.map(|v| &self.vertices[v as usize])
    }

    /// The place on its triangle, m, body axes.
    pub(crate) fn rest(&self, place: &Place) -> Vector3<f64> {
        self.corners(place).iter().zip(place.weights).map(|(x, w)| **x * w).sum()
    }

    /// The normal of the smooth surface, that of the triangle, and the height of the smooth surface
    /// above the triangle, m. Body axes, at rest.
    pub(crate) fn normals(&self, place: &Place) -> (Vector3<f64>, Vector3<f64>, f64) {
        let facet = &self.facets[place.facet as usize];
        let rest = self.rest(place);
        let (mut normal, mut rise) = (Vector3::zeros(), 0.0);
        for ((smooth, corner), weight) in facet.smooth.iter().zip(self.corners(place)).zip(place.weights) {
            normal += weight * smooth;
            rise += 0.5 * weight * smooth.dot(&(corner - rest));
        }
        let length = normal.norm();
        let normal = if length > 0.1 { normal / length } else { facet.normal };
        (normal, facet.normal, rise)
    }

    /// The sites that carry one corner of a place's triangle.
    pub(crate) fn corner_carriers(&self, place: &Place, corner: usize) -> &[(u32, f64)] {
        &self.carriers[self.facets[place.facet as usize].corners[corner] as usize]
    }

    /// The sites that carry a place.
    pub(crate) fn carriers(&self, place: &Place) -> Carriers {
        let mut all = Carriers { list: [(0, 0.0); MAX_CARRIERS], count: 0 };
        for (corner, weight) in place.weights.iter().enumerate() {
            if *weight != 0.0 {
                for &(site, share) in self.corner_carriers(place, corner) {
                    all.add(site, weight * share);
                }
            }
        }
        all
    }
}
