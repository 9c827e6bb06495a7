//! Removes contacts of measure zero, where two pieces of a mesh share a node or an edge but no
//! face.

use crate::{TetMesh, surface::Connected, tets::signed_volume};

/// Makes the boundary a manifold. Returns the number of tetrahedra that were dropped for this.
///
/// Lattice points that were moved onto the surface can join pieces in a single node or along a
/// single edge, where the shape is thin or nearly touches itself. If the tetrahedra around a node
/// form several groups, each group gets a node of its own, which loses nothing. Where groups within
/// one node's group share an edge, only the largest group is kept. Where a cavity touches the
/// outside in a single node, the tetrahedra around that node are dropped. Both cases are rare.
pub(super) fn part_contacts(mesh: &mut TetMesh, on_surface: &mut Vec<bool>) -> usize {
    let before = mesh.tets.len();
    loop {
        part_nodes(mesh, on_surface);
        let mut dropped = edge_contacts(mesh, on_surface);
        if !dropped.contains(&true) {
            dropped = hollow_contacts(mesh);
        }
        if !dropped.contains(&true) {
            return before - mesh.tets.len();
        }
        let mut keep = dropped.iter().map(|d| !d);
        mesh.tets.retain(|_| keep.next().unwrap_or(true));
        // A dropped tetrahedron exposes nodes that were inside.
        on_surface.fill(true);
    }
}

/// Gives each group of tetrahedra around a node, connected by faces at that node, a node of its
/// own.
fn part_nodes(mesh: &mut TetMesh, on_surface: &mut Vec<bool>) {
    let around = tets_around(mesh);
    for node in 0..on_surface.len() {
        let tets = around.of(node);
        if !on_surface[node] || tets.len() < 2 {
            continue;
        }
        let groups = groups(tets, |a, b| shared(mesh.tets[a as usize], mesh.tets[b as usize]) == 3);
        let count = groups.iter().max().map_or(0, |g| g + 1);
        for group in 1..count {
            let copy = mesh.nodes.len() as u32;
            mesh.nodes.push(mesh.nodes[node]);
            on_surface.push(true);
            for (&tet, _) in tets.iter().zip(&groups).filter(|(_, g)| **g == group) {
                for n in mesh.tets[tet as usize].iter_mut().filter(|n| **n as usize == node) {
                    *n = copy;
                }
            }
        }
    }
}

/// Marks the tetrahedra to drop: if those around an edge form several groups, all groups but the
/// largest.
fn edge_contacts(mesh: &TetMesh, on_surface: &[bool]) -> Vec<bool> {
    const EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
    let mut around: Vec<([u32; 2], u32)> = Vec::new();
    for (tet, nodes) in mesh.tets.iter().enumerate() {
        for [i, j] in EDGES {
            let (a, b) = (nodes[i].min(nodes[j]), nodes[i].max(nodes[j]));
            if on_surface[a as usize] && on_surface[b as usize] {
                around.push(([a, b], tet as u32));
            }
        }
    }
    around.sort_unstable();
    let mut dropped = vec![false; mesh.tets.len()];
    for same in around.chunk_by(|a, b| a.0 == b.0).filter(|s| s.len() > 1) {
        let tets: Vec<u32> = same.iter().map(|s| s.1).collect();
        let groups = groups(&tets, |a, b| shared(mesh.tets[a as usize], mesh.tets[b as usize]) == 3);
        let count = groups.iter().max().map_or(0, |g| g + 1);
        let size = |group: u32| groups.iter().filter(|&&g| g == group).count();
        let largest = (0..count).rev().max_by_key(|&g| size(g));
        for (&tet, group) in tets.iter().zip(&groups) {
            dropped[tet as usize] |= Some(*group) != largest;
        }
    }
    dropped
}

/// Marks the tetrahedra to drop: those around a node where the boundary has more than one fan of
/// triangles.
fn hollow_contacts(mesh: &TetMesh) -> Vec<bool> {
    let (surface, nodes) = mesh.boundary();
    let mut fans: Vec<Vec<[u32; 2]>> = vec![Vec::new(); surface.positions.len()];
    for &[a, b, c] in &surface.triangles {
        for (v, from, to) in [(a, b, c), (b, c, a), (c, a, b)] {
            fans[v as usize].push([from, to]);
        }
    }
    let mut torn = vec![false; mesh.nodes.len()];
    for (fan, &node) in fans.iter().zip(&nodes) {
        // Each edge has two triangles at this stage, so the walk around the node returns to its
        // start.
        let start = fan[0][0];
        let mut at = start;
        let mut turns = 0;
        while let Some(step) = fan.iter().find(|f| f[0] == at) {
            at = step[1];
            turns += 1;
            if at == start || turns > fan.len() {
                break;
            }
        }
        torn[node as usize] = turns != fan.len();
    }
    mesh.tets.iter().map(|t| t.iter().any(|&n| torn[n as usize])).collect()
}

/// Keeps the tetrahedra of the piece (connected by nodes) with the largest volume.
pub(super) fn keep_largest_part(mesh: &mut TetMesh) {
    let mut parts = Connected::new(mesh.nodes.len());
    for tet in &mesh.tets {
        for &n in &tet[1..] {
            parts.join(tet[0], n);
        }
    }
    let roots: Vec<u32> = mesh.tets.iter().map(|t| parts.of(t[0])).collect();
    let mut volume = vec![0.0; mesh.nodes.len()];
    for (tet, &root) in mesh.tets.iter().zip(&roots) {
        volume[root as usize] += signed_volume(mesh.corners(*tet));
    }
    let largest = (0..volume.len() as u32).max_by(|&a, &b| volume[a as usize].total_cmp(&volume[b as usize]));
    let mut roots = roots.into_iter();
    mesh.tets.retain(|_| roots.next() == largest);
}

/// Returns the group of each item, numbered from 0 by first appearance. Items that `joined`
/// connects are in one group.
fn groups(items: &[u32], joined: impl Fn(u32, u32) -> bool) -> Vec<u32> {
    let mut group = vec![u32::MAX; items.len()];
    let mut count = 0;
    let mut stack = Vec::new();
    for start in 0..items.len() {
        if group[start] != u32::MAX {
            continue;
        }
        group[start] = count;
        stack.push(start);
        while let Some(at) = stack.pop() {
            for other in 0..items.len() {
                if group[other] == u32::MAX && joined(items[at], items[other]) {
                    group[other] = count;
                    stack.push(other);
                }
            }
        }
        count += 1;
    }
    group
}

/// Returns the number of nodes that two tetrahedra share.
fn shared(a: [u32; 4], b: [u32; 4]) -> usize {
    a.iter().filter(|n| b.contains(n)).count()
}

/// Tetrahedra at each node, in one list.
pub(super) struct Around {
    start: Vec<u32>,
    tets: Vec<u32>,
}

impl Around {
    pub(super) fn of(&self, node: usize) -> &[u32] {
        &self.tets[self.start[node] as usize..self.start[node + 1] as usize]
    }
}

pub(super) fn tets_around(mesh: &TetMesh) -> Around {
    let mut start = vec![0; mesh.nodes.len() + 1];
    for &n in mesh.tets.iter().flatten() {
        start[n as usize + 1] += 1;
    }
    for n in 1..start.len() {
        start[n] += start[n - 1];
    }
    let mut next = start.clone();
    let mut tets = vec![0; 4 * mesh.tets.len()];
    for (tet, nodes) in mesh.tets.iter().enumerate() {
        for &n in nodes {
            tets[next[n as usize] as usize] = tet as u32;
            next[n as usize] += 1;
        }
    }
    Around { start, tets }
}
