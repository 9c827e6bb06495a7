//! Divides the inside part of one lattice tetrahedron into tetrahedra.

use super::lattice::{LatticeSide, Point, is_long, sub};

/// Node of the mesh: a lattice point, or the cut point between two lattice points (the inside one
/// first).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StencilNode {
    Point(Point),
    Cut(Point, Point),
}

/// Calls `emit` for each tetrahedron that fills the inside part of a lattice tetrahedron with these
/// corners and sides.
///
/// The caller fixes the orientation. Corners inside and on the surface are kept. A cut point lies
/// between a corner inside and one outside. The remaining part is a tetrahedron, a pyramid or a
/// prism. [`diagonal_starts_at_first`] selects the diagonals of the quadrilaterals, so that
/// neighbors agree.
pub(super) fn fill(corners: [Point; 4], sides: [LatticeSide; 4], mut emit: impl FnMut([StencilNode; 4])) {
    let of = |side: LatticeSide| {
        let mut points = [[0; 3]; 4];
        let mut count = 0;
        for i in (0..4).filter(|&i| sides[i] == side) {
            points[count] = corners[i];
            count += 1;
        }
        (points, count)
    };
    let (inside, inside_count) = of(LatticeSide::Inside);
    let (outside, outside_count) = of(LatticeSide::Outside);
    let (on, _) = of(LatticeSide::On);
    let cut = |i: usize, o: usize| StencilNode::Cut(inside[i], outside[o]);
    let (p, q) = (StencilNode::Point(inside[0]), StencilNode::Point(inside[1]));
    match (inside_count, outside_count) {
        (0, _) => {}
        (_, 0) => emit(corners.map(StencilNode::Point)),
        (1, 1) => emit([p, cut(0, 0), StencilNode::Point(on[0]), StencilNode::Point(on[1])]),
        (1, 2) => emit([p, cut(0, 0), cut(0, 1), StencilNode::Point(on[0])]),
        (1, _) => emit([p, cut(0, 0), cut(0, 1), cut(0, 2)]),
        (2, 1) => {
            // The rest is a pyramid over the quadrilateral p, q, cut q, cut p.
            let top = StencilNode::Point(on[0]);
            let (from, to, rest) = if diagonal_starts_at_first(inside[0], inside[1], outside[0]) {
                (p, cut(1, 0), [q, cut(0, 0)])
            } else {
                (q, cut(0, 0), [p, cut(1, 0)])
            };
            for corner in rest {
                emit([from, to, corner, top]);
            }
        }
        (2, _) => {
            // The rest is a prism between the triangles at p and at q. The other two diagonals
            // determine that of the third side, which lies on the surface.
            let first = |o| diagonal_starts_at_first(inside[0], inside[1], outside[o]);
            let (d01, d02) = (first(0), first(1));
            // If both diagonals start at the same end, either choice is valid for the third one.
            let d12 = if d01 == d02 { true } else { d02 };
            prism([p, cut(0, 0), cut(0, 1)], [q, cut(1, 0), cut(1, 1)], [d01, d02, d12], emit);
        }
        (_, _) => {
            // The corner outside is cut off, and a prism remains.
            let r = StencilNode::Point(inside[2]);
            let first = |i: usize, j: usize| diagonal_starts_at_first(inside[i], inside[j], outside[0]);
            prism(
                [p, q, r],
                [cut(0, 0), cut(1, 0), cut(2, 0)],
                [first(0, 1), first(0, 2), first(1, 2)],
                emit,
            );
        }
    }
}

/// Selects the diagonal of a face with the corners `a` and `b` inside and the third, `out`,
/// outside.
///
/// Returns true if the diagonal goes from `a` to the cut point next to `b`, and false if it goes
/// from `b` to the cut point next to `a`. A cut point on a long edge keeps the diagonal, because
/// the angles are wider there. If both cut edges are short, parity decides. The number of
/// coordinates in which an end of the long edge exceeds `out` is even for one end and odd for the
/// other. It alternates from face to face around the edge, which prevents twisted prisms (Labelle
/// and Shewchuk 2007, the parity rule).
fn diagonal_starts_at_first(a: Point, b: Point, out: Point) -> bool {
    if is_long(sub(a, out)) {
        false
    } else if is_long(sub(b, out)) {
        true
    } else {
        (0..3).filter(|&i| a[i] > out[i]).count() % 2 == 0
    }
}

/// Divides the prism between the triangles `a` and `b` into three tetrahedra.
///
/// `diagonals` say for the sides (0, 1), (0, 2) and (1, 2) whether the diagonal starts from `a` at
/// the first of the two indices. The diagonals must not all turn in the same direction.
fn prism(
    a: [StencilNode; 3],
    b: [StencilNode; 3],
    diagonals: [bool; 3],
    mut emit: impl FnMut([StencilNode; 4]),
) {
    let [d01, d02, d12] = diagonals.map(usize::from);
    // The numbers of diagonals that start at each a[i] are 2, 1 and 0 in some order.
    let leaving = [d01 + d02, 1 - d01 + d12, 2 - d02 - d12];
    let at = |count| leaving.iter().position(|&n| n == count).unwrap_or(0);
    let (i, j, k) = (at(2), at(1), at(0));
    emit([a[i], a[j], a[k], b[k]]);
    emit([a[i], a[j], b[j], b[k]]);
    emit([a[i], b[i], b[j], b[k]]);
}
