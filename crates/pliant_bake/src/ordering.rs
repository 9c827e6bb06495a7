//! Fill-reducing ordering: nested dissection by coordinate bisection (George 1973, with known
//! geometry).
//!
//! A set of nodes is halved at the median of a coordinate. The edges across the cut form a
//! bipartite graph. Its smallest vertex cover (Koenig's theorem, from a maximum matching by
//! Hopcroft and Karp) is the smallest separator of that cut. Both halves come first, each ordered
//! recursively, and the separator comes last.

use crate::fem::Lists;

/// Largest set that is not divided further.
const LEAF: usize = 10;

/// Size above which a set tries all three axes and keeps the smallest separator.
const TRY_ALL_AXES: usize = 200;

/// Returns the elimination order of the nodes: position to node.
///
/// Only nodes with `keep` take part. `graph` is the whole graph.
pub(crate) fn nested_dissection(graph: &Lists, positions: &[[f64; 3]], keep: &[bool]) -> Vec<u32> {
    let nodes: Vec<u32> = (0..positions.len() as u32).filter(|&i| keep[i as usize]).collect();
    let mut order = Vec::with_capacity(nodes.len());
    let mut dissection =
        Dissection { graph, positions, part: vec![NONE; positions.len()], local: vec![0; positions.len()] };
    dissection.split(nodes, &mut order);
    order
}

const NONE: u32 = u32::MAX;

struct Dissection<'a> {
    graph: &'a Lists,
    positions: &'a [[f64; 3]],
    /// Side of the current cut, 0 or 1, or `NONE` for nodes outside the cut.
    part: Vec<u32>,
    /// Index of a node among the border nodes of its side, or `NONE` for inner nodes.
    local: Vec<u32>,
}

impl Dissection<'_> {
    /// Orders a set recursively. Each call at least halves the set, so the recursion depth is
    /// logarithmic.
    fn split(&mut self, mut nodes: Vec<u32>, order: &mut Vec<u32>) {
        if nodes.len() <= LEAF {
            order.append(&mut nodes);
            return;
        }
        let extent = self.extent(&nodes);
        let mut axes = [0, 1, 2];
        axes.sort_by(|&a, &b| extent[b].total_cmp(&extent[a]));
        let tries = if nodes.len() > TRY_ALL_AXES { 3 } else { 1 };
        let mut best: Option<(Vec<u32>, usize)> = None;
        for &axis in &axes[..tries] {
            // An axis that is much shorter than the longest one cannot give the smaller cut.
            if extent[axis] < 0.3 * extent[axes[0]] {
                continue;
            }
            let cover = self.separator(&mut nodes, axis);
            if best.as_ref().is_none_or(|(smallest, _)| cover.len() < smallest.len()) {
                best = Some((cover, axis));
            }
        }
        let Some((mut cover, axis)) = best else {
            order.append(&mut nodes);
            return;
        };
        self.halve(&mut nodes, axis);
        let half = nodes.len() / 2;
        cover.sort_unstable();
        let inner = |side: &[u32]| -> Vec<u32> {
            side.iter().copied().filter(|node| cover.binary_search(node).is_err()).collect()
        };
        let (left, right) = (inner(&nodes[..half]), inner(&nodes[half..]));
        drop(nodes);
        self.split(left, order);
        self.split(right, order);
        let extent = self.extent(&cover);
        let axis = (0..3).max_by(|&a, &b| extent[a].total_cmp(&extent[b])).unwrap_or(0);
        self.sort(&mut cover, axis);
        order.append(&mut cover);
    }

    fn extent(&self, nodes: &[u32]) -> [f64; 3] {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for &node in nodes {
            for k in 0..3 {
                low[k] = low[k].min(self.positions[node as usize][k]);
                high[k] = high[k].max(self.positions[node as usize][k]);
            }
        }
        [0, 1, 2].map(|k| high[k] - low[k])
    }

    fn compare(&self, axis: usize) -> impl Fn(&u32, &u32) -> std::cmp::Ordering + '_ {
        move |&a, &b| {
            let (p, q) = (self.positions[a as usize], self.positions[b as usize]);
            p[axis].total_cmp(&q[axis]).then(a.cmp(&b))
        }
    }

    fn halve(&self, nodes: &mut [u32], axis: usize) {
        let half = nodes.len() / 2;
        nodes.select_nth_unstable_by(half, self.compare(axis));
    }

    fn sort(&self, nodes: &mut [u32], axis: usize) {
        nodes.sort_unstable_by(self.compare(axis));
    }

    /// Returns the smallest vertex cover of the edges between the two halves along `axis`.
    fn separator(&mut self, nodes: &mut [u32], axis: usize) -> Vec<u32> {
        self.halve(nodes, axis);
        let half = nodes.len() / 2;
        for (i, &node) in nodes.iter().enumerate() {
            self.part[node as usize] = u32::from(i >= half);
            self.local[node as usize] = NONE;
        }
        // These are the border nodes of each side and the crossing edges from left to right.
        let mut border: [Vec<u32>; 2] = [Vec::new(), Vec::new()];
        for &node in nodes.iter() {
            let side = self.part[node as usize];
            if self.graph.of(node as usize).iter().any(|&other| self.part[other as usize] == 1 - side) {
                self.local[node as usize] = border[side as usize].len() as u32;
                border[side as usize].push(node);
            }
        }
        let mut edges = Lists { offsets: vec![0], items: Vec::new() };
        for &node in &border[0] {
            edges.items.extend(
                self.graph
                    .of(node as usize)
                    .iter()
                    .filter(|&&other| self.part[other as usize] == 1)
                    .map(|&other| self.local[other as usize]),
            );
            edges.offsets.push(edges.items.len());
        }
        for &node in nodes.iter() {
            self.part[node as usize] = NONE;
        }
        let (left, right) = smallest_cover(&edges, border[1].len());
        let chosen = |members: &[u32], chosen: &[bool]| -> Vec<u32> {
            members.iter().zip(chosen).filter(|(_, chosen)| **chosen).map(|(&node, _)| node).collect()
        };
        let mut cover = chosen(&border[0], &left);
        cover.extend(chosen(&border[1], &right));
        cover
    }
}

/// Returns the smallest vertex cover of a bipartite graph. `edges` lists the right neighbors of
/// each left vertex.
fn smallest_cover(edges: &Lists, rights: usize) -> (Vec<bool>, Vec<bool>) {
    let lefts = edges.len();
    let (mut mate_left, mut mate_right) = (vec![NONE; lefts], vec![NONE; rights]);
    for (left, mate) in mate_left.iter_mut().enumerate() {
        if let Some(&right) = edges.of(left).iter().find(|&&right| mate_right[right as usize] == NONE) {
            *mate = right;
            mate_right[right as usize] = left as u32;
        }
    }
    let mut depth = vec![0u32; lefts];
    let mut queue: Vec<u32> = Vec::with_capacity(lefts);
    loop {
        // The breadth-first search makes layers from the unmatched left vertices.
        queue.clear();
        for left in 0..lefts {
            depth[left] = if mate_left[left] == NONE {
                queue.push(left as u32);
                0
            } else {
                NONE
            };
        }
        let mut found = false;
        let mut head = 0;
        while head < queue.len() {
            let left = queue[head] as usize;
            head += 1;
            for &right in edges.of(left) {
                let next = mate_right[right as usize];
                if next == NONE {
                    found = true;
                } else if depth[next as usize] == NONE {
                    depth[next as usize] = depth[left] + 1;
                    queue.push(next);
                }
            }
        }
        if !found {
            break;
        }
        let mut cursor: Vec<usize> = edges.offsets[..lefts].to_vec();
        for root in 0..lefts {
            if mate_left[root] == NONE {
                augment(edges, root, &mut cursor, &mut depth, &mut mate_left, &mut mate_right);
            }
        }
    }
    // Koenig's theorem needs the vertices that alternating paths reach from unmatched left
    // vertices. `depth` marks them after the last sweep.
    let reached = |left: usize| depth[left] != NONE;
    let mut right_reached = vec![false; rights];
    for left in (0..lefts).filter(|&left| reached(left)) {
        for &right in edges.of(left) {
            right_reached[right as usize] = true;
        }
    }
    let left_cover = (0..lefts).map(|left| !reached(left) && !edges.of(left).is_empty()).collect();
    (left_cover, right_reached)
}

/// Searches depth-first for one augmenting path along the layers, with an explicit stack.
fn augment(
    edges: &Lists,
    root: usize,
    cursor: &mut [usize],
    depth: &mut [u32],
    mate_left: &mut [u32],
    mate_right: &mut [u32],
) {
    let mut path = vec![root];
    while let Some(&left) = path.last() {
        if cursor[left] == edges.offsets[left + 1] {
            depth[left] = NONE;
            path.pop();
            continue;
        }
        let right = edges.items[cursor[left]];
        cursor[left] += 1;
        let next = mate_right[right as usize];
        if next == NONE {
            // The path is flipped from its end. Each left vertex takes the right vertex that its
            // cursor has just passed.
            for &left in path.iter().rev() {
                let right = edges.items[cursor[left] - 1];
                mate_left[left] = right;
                mate_right[right as usize] = left as u32;
            }
            return;
        }
        if depth[next as usize] == depth[left] + 1 {
            path.push(next as usize);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cover_is_as_large_as_the_matching_and_covers() {
        // The graph is a star beside a path, so the cover has 1 + 2 vertices.
        let lists = [vec![0, 1, 2], vec![3], vec![3, 4], vec![4]];
        let mut edges = Lists { offsets: vec![0], items: Vec::new() };
        for list in &lists {
            edges.items.extend(list);
            edges.offsets.push(edges.items.len());
        }
        let (left, right) = smallest_cover(&edges, 5);
        for (i, list) in lists.iter().enumerate() {
            assert!(list.iter().all(|&j: &u32| left[i] || right[j as usize]));
        }
        let size = left.iter().chain(&right).filter(|c| **c).count();
        assert_eq!(size, 3);
    }
}
