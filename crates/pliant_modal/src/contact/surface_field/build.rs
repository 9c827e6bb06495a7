//! Makes the field of a surface: normals, trees, and the sites that carry each vertex.

use nalgebra::{Matrix4, Vector3, Vector4};

use super::{CARRIERS, Cluster, Facet, Node, Place, SMOOTH, SurfaceField};
use crate::{ModalModel, contact::sites::Site};

/// Largest number of triangles in a leaf of the tree.
const LEAF: usize = 4;

/// Largest number of sites in a leaf of the tree of sites.
const CLUSTER: usize = 3;

/// Strain by which the surface may stretch around a site without being missed.
const STRETCH: f64 = 1.25;

impl SurfaceField {
    /// Makes the field of a model's surface, carried by its contact sites.
    pub(crate) fn new(model: &ModalModel, sites: &[Site]) -> Self {
        let surface = model.surface();
        let mut vertices = vec![Vector3::zeros(); surface.welded_count()];
        let mut anchored = vec![false; surface.welded_count()];
        for (v, position) in surface.positions().iter().enumerate() {
            let w = surface.welded()[v] as usize;
            vertices[w] = Vector3::from(position.map(f64::from));
            anchored[w] |= surface.anchored()[v];
        }
        let mut facets: Vec<Facet> = Vec::with_capacity(surface.triangles().len());
        for triangle in surface.triangles() {
            let corners = triangle.map(|v| surface.welded()[v as usize]);
            let [a, b, c] = corners.map(|v| vertices[v as usize]);
            let across = (b - a).cross(&(c - a));
            let area = across.norm();
            // A triangle without area has no normal, and others are as near.
            if area > 0.0 {
                let normal = across / area;
                facets.push(Facet { corners, normal, smooth: [normal; 3], sharp: [[false; 2]; 3] });
            }
        }
        smoothen(&vertices, &mut facets);
        let mut order: Vec<usize> = (0..facets.len()).collect();
        let mut nodes = Vec::new();
        if !facets.is_empty() {
            split(&vertices, &facets, &mut order, 0, &mut nodes);
        }
        let mut sorted: Vec<Option<Facet>> = facets.into_iter().map(Some).collect();
        let facets = order.iter().filter_map(|&index| sorted[index].take()).collect();
        let carriers = vertices
            .iter()
            .zip(&anchored)
            .map(
                |(at, anchored)| if *anchored { Vec::new() } else { carriers(at, sites, surface, &vertices) },
            )
            .collect();
        let (sites_of, clusters, places) = (Vec::new(), Vec::new(), Vec::new());
        let mut field = Self { vertices, facets, nodes, sites: sites_of, clusters, places, carriers };
        field.gather(sites);
        field
    }

    /// Makes the tree of the sites.
    fn gather(&mut self, sites: &[Site]) {
        let place = |site: u32| sites[site as usize].rest(&sites[site as usize].outward);
        self.sites = (0..sites.len() as u32).collect();
        if !sites.is_empty() {
            gather(&place, &mut self.sites, 0, &mut self.clusters);
        }
        let mut leaf_of = vec![0; sites.len()];
        for (number, cluster) in self.clusters.iter().enumerate().filter(|(_, cluster)| cluster.is_leaf()) {
            self.sites[cluster.first..cluster.end].iter().for_each(|&site| leaf_of[site as usize] = number);
        }
        let unknown = Place { facet: 0, weights: [1.0, 0.0, 0.0] };
        self.places = vec![unknown; sites.len()];
        let mut nearest_place = vec![f64::INFINITY; sites.len()];
        for (number, facet) in self.facets.iter().enumerate() {
            let corners = facet.corners.map(|v| &self.vertices[v as usize]);
            let longest = (0..3).map(|k| (corners[k] - corners[(k + 1) % 3]).norm()).fold(0.0, f64::max);
            for (corner, at) in corners.into_iter().enumerate() {
                let near = |site: &&u32| (place(**site) - at).norm_squared();
                let nearest = self.sites.iter().min_by(|a, b| near(a).total_cmp(&near(b)));
                let Some(&nearest) = nearest else { continue };
                // A point of a triangle is nearer to a corner than this.
                let cover = |distance: f64| STRETCH * (distance + 0.6 * longest);
                let nearest = nearest as usize;
                let distance = (place(nearest as u32) - at).norm();
                if distance < nearest_place[nearest] {
                    nearest_place[nearest] = distance;
                    let mut weights = [0.0; 3];
                    weights[corner] = 1.0;
                    self.places[nearest] = Place { facet: number as u32, weights };
                }
                let leaf = &mut self.clusters[leaf_of[nearest]];
                leaf.cover = leaf.cover.max(cover(distance));
            }
        }
        for number in (0..self.clusters.len()).rev() {
            if let Some(second) = self.clusters[number].second {
                let cover = self.clusters[number + 1].cover.max(self.clusters[second].cover);
                self.clusters[number].cover = cover;
            }
        }
    }
}

/// Gives the corners of all triangles the mean normals of the triangles around them that meet at
/// small angles, and tells which corners and edges have others.
fn smoothen(vertices: &[Vector3<f64>], facets: &mut [Facet]) {
    let mut around: Vec<Vec<u32>> = vec![Vec::new(); vertices.len()];
    for (index, facet) in facets.iter().enumerate() {
        facet.corners.iter().for_each(|&v| around[v as usize].push(index as u32));
    }
    // The angle of a triangle at the vertex is its weight, so that the triangulation of a face
    // makes no difference.
    let angle = |facet: &Facet, vertex: u32| {
        let at = facet.corners.iter().position(|v| *v == vertex).unwrap_or(0);
        let [a, b, c] = [0, 1, 2].map(|k| vertices[facet.corners[(at + k) % 3] as usize]);
        (b - a).angle(&(c - a))
    };
    for index in 0..facets.len() {
        let (corners, own) = (facets[index].corners, facets[index].normal);
        facets[index].smooth = corners.map(|vertex| {
            let mut sum = Vector3::zeros();
            for &other in &around[vertex as usize] {
                let other = &facets[other as usize];
                if other.normal.dot(&own) > SMOOTH {
                    sum += angle(other, vertex) * other.normal;
                }
            }
            sum.try_normalize(1e-9).unwrap_or(own)
        });
        facets[index].sharp = [0, 1, 2].map(|k| {
            let (from, to) = (corners[k], corners[(k + 1) % 3]);
            let others = around[from as usize].iter().map(|&other| &facets[other as usize]);
            let mut others = others.filter(|other| other.normal.dot(&own) <= SMOOTH);
            let beyond = others.clone().any(|other| other.corners.contains(&to));
            [others.next().is_some(), beyond]
        });
    }
}

/// Builds the node of the triangles `order`, which begin at `first`, and those below it.
fn split(
    vertices: &[Vector3<f64>],
    facets: &[Facet],
    order: &mut [usize],
    first: usize,
    nodes: &mut Vec<Node>,
) {
    let corners = |index: usize| facets[index].corners.map(|v| vertices[v as usize]);
    let middle = |index: usize| corners(index).iter().sum::<Vector3<f64>>() / 3.0;
    let (mut low, mut high) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
    for corner in order.iter().flat_map(|&index| corners(index)) {
        (low, high) = (low.inf(&corner), high.sup(&corner));
    }
    let mut normals = [Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)];
    for normal in order.iter().map(|&index| &facets[index].normal) {
        normals = [normals[0].inf(normal), normals[1].sup(normal)];
    }
    let node = nodes.len();
    nodes.push(Node { low, high, normals, first: first as u32, count: order.len() as u32 });
    if order.len() <= LEAF {
        return;
    }
    let axis = (high - low).imax();
    order.sort_by(|&a, &b| middle(a)[axis].total_cmp(&middle(b)[axis]).then(a.cmp(&b)));
    let (left, right) = order.split_at_mut(order.len() / 2);
    split(vertices, facets, left, first, nodes);
    nodes[node].count = 0;
    nodes[node].first = nodes.len() as u32;
    let second = first + left.len();
    split(vertices, facets, right, second, nodes);
}

/// Builds the node of the sites `order`, which begin at `first`, and those below it.
fn gather(place: &impl Fn(u32) -> Vector3<f64>, order: &mut [u32], first: usize, nodes: &mut Vec<Cluster>) {
    let node = nodes.len();
    nodes.push(Cluster { first, end: first + order.len(), second: None, cover: 0.0 });
    if order.len() <= CLUSTER {
        return;
    }
    let (mut low, mut high) = (place(order[0]), place(order[0]));
    for at in order.iter().map(|&site| place(site)) {
        (low, high) = (low.inf(&at), high.sup(&at));
    }
    let axis = (high - low).imax();
    order.sort_by(|&a, &b| place(a)[axis].total_cmp(&place(b)[axis]).then(a.cmp(&b)));
    let (left, right) = order.split_at_mut(order.len() / 2);
    gather(place, left, first, nodes);
    nodes[node].second = Some(nodes.len());
    gather(place, right, first + left.len(), nodes);
}

/// The sites around a vertex with weights that reproduce a linear field.
fn carriers(
    at: &Vector3<f64>,
    sites: &[Site],
    surface: &crate::SurfaceMesh,
    vertices: &[Vector3<f64>],
) -> Vec<(u32, f64)> {
    let place = |site: &Site| vertices[surface.welded()[site.vertex as usize] as usize];
    // The nearest sites, and the next one, at which weights vanish.
    let mut nearest = [(f64::INFINITY, usize::MAX); CARRIERS + 1];
    for (index, site) in sites.iter().enumerate() {
        let distance = (place(site) - at).norm();
        if let Some(slot) = nearest.iter().position(|(known, _)| distance < *known) {
            nearest[slot..].rotate_right(1);
            nearest[slot] = (distance, index);
        }
    }
    let (closest, first) = nearest[0];
    if first == usize::MAX {
        return Vec::new();
    }
    if closest <= 0.0 || nearest[1].1 == usize::MAX {
        return vec![(first as u32, 1.0)];
    }
    let used = || nearest[..CARRIERS].iter().filter(|(_, index)| *index != usize::MAX);
    let reach = nearest[CARRIERS].0.min(2.0 * used().fold(0.0f64, |far, (d, _)| far.max(*d)));
    let base = |index: usize| {
        let way = (place(&sites[index]) - at) / reach;
        Vector4::new(1.0, way.x, way.y, way.z)
    };
    let weight = |distance: f64| (1.0 - distance / reach).max(1e-3).powi(2);
    let mut moments = Matrix4::zeros();
    for &(distance, index) in used() {
        moments += weight(distance) * base(index) * base(index).transpose();
    }
    // Sites may lie in a plane or on a line. The field across it is then taken as constant.
    let ridge = 1e-4 * moments[(0, 0)];
    (1..4).for_each(|k| moments[(k, k)] += ridge);
    let Some(solved) = moments.cholesky().map(|factor| factor.solve(&Vector4::x())) else {
        return vec![(first as u32, 1.0)];
    };
    let mut list: Vec<(u32, f64)> =
        used().map(|&(d, index)| (index as u32, weight(d) * solved.dot(&base(index)))).collect();
    let sum: f64 = list.iter().map(|(_, weight)| weight).sum();
    if !(sum > 0.1 && list.iter().all(|(_, weight)| weight.abs() < 4.0 * sum)) {
        return vec![(first as u32, 1.0)];
    }
    list.iter_mut().for_each(|(_, weight)| *weight /= sum);
    list
}
