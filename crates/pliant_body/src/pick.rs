//! Intersection of a ray with the deformed surface.

/// The first intersection of a ray with a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceHit {
    /// Index of the intersected triangle in the surface's triangles.
    pub triangle: usize,
    /// Vertex of that triangle that is nearest to the intersection.
    pub vertex: u32,
    /// Distance along the ray, in lengths of its direction.
    pub distance: f64,
    /// Intersection point, m, in the axes of the positions.
    pub point: [f64; 3],
}

/// Returns the nearest triangle that the ray from `origin` along `direction` intersects.
///
/// Triangles behind the origin are ignored. Both sides of a triangle count. The function tests
/// every triangle (10,000 take some tens of microseconds), because the shape changes in each frame:
/// a tree would need a refit more often than a click queries it. The test follows Möller and
/// Trumbore, *Fast, Minimum Storage Ray/Triangle Intersection*, 1997, in double precision.
/// Triangles with an index beyond `positions` are skipped.
pub fn pick_surface(
    positions: &[[f32; 3]],
    triangles: &[[u32; 3]],
    origin: [f64; 3],
    direction: [f64; 3],
) -> Option<SurfaceHit> {
    let mut nearest: Option<(usize, f64)> = None;
    for (index, triangle) in triangles.iter().enumerate() {
        let Some(corners) = corners(positions, triangle) else { continue };
        if let Some(distance) = intersect(&corners, origin, direction)
            && nearest.is_none_or(|(_, best)| distance < best)
        {
            nearest = Some((index, distance));
        }
    }
    let (index, distance) = nearest?;
    let triangle = triangles.get(index)?;
    let point: [f64; 3] = std::array::from_fn(|k| origin[k] + distance * direction[k]);
    let corners = corners(positions, triangle)?;
    let apart = |corner: &[f64; 3]| (0..3).map(|k| (corner[k] - point[k]).powi(2)).sum::<f64>();
    let (vertex, _) = triangle
        .iter()
        .zip(&corners)
        .map(|(&vertex, corner)| (vertex, apart(corner)))
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(SurfaceHit { triangle: index, vertex, distance, point })
}

fn corners(positions: &[[f32; 3]], triangle: &[u32; 3]) -> Option<[[f64; 3]; 3]> {
    let mut corners = [[0.0; 3]; 3];
    for (corner, &vertex) in corners.iter_mut().zip(triangle) {
        *corner = positions.get(vertex as usize)?.map(f64::from);
    }
    Some(corners)
}

/// Returns the distance along the ray to the triangle. Returns `None` if the triangle is behind the
/// origin, if the ray misses it, or if the ray is parallel to its plane.
fn intersect([a, b, c]: &[[f64; 3]; 3], origin: [f64; 3], direction: [f64; 3]) -> Option<f64> {
    let (ab, ac) = (sub(*b, *a), sub(*c, *a));
    let p = cross(direction, ac);
    let determinant = dot(ab, p);
    if determinant == 0.0 {
        return None;
    }
    let from_a = sub(origin, *a);
    let u = dot(from_a, p) / determinant;
    let q = cross(from_a, ab);
    let v = dot(direction, q) / determinant;
    let distance = dot(ac, q) / determinant;
    let inside = u >= 0.0 && v >= 0.0 && u + v <= 1.0;
    (inside && distance > 0.0 && distance.is_finite()).then_some(distance)
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [[f32; 3]; 8] = [
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [1.0, 1.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, -2.0],
        [1.0, 0.0, -2.0],
        [1.0, 1.0, -2.0],
        [0.0, 1.0, -2.0],
    ];
    const TRIANGLES: [[u32; 3]; 4] = [[4, 5, 6], [4, 6, 7], [0, 1, 2], [0, 2, 3]];

    #[test]
    fn the_nearer_of_two_sheets_is_hit_at_its_nearest_corner() {
        let hit = pick_surface(&SQUARE, &TRIANGLES, [0.9, 0.2, 3.0], [0.0, 0.0, -0.5]).unwrap();
        // The sheet at z = 0 is three meters away: six lengths of a direction of half a meter.
        assert_eq!((hit.triangle, hit.vertex, hit.distance), (2, 1, 6.0));
        assert_eq!(hit.point, [0.9, 0.2, 0.0]);
    }

    #[test]
    fn nothing_beside_or_behind_is_hit() {
        assert_eq!(pick_surface(&SQUARE, &TRIANGLES, [1.5, 0.2, 3.0], [0.0, 0.0, -1.0]), None);
        assert_eq!(pick_surface(&SQUARE, &TRIANGLES, [0.5, 0.2, 3.0], [0.0, 0.0, 1.0]), None);
        assert_eq!(pick_surface(&SQUARE, &TRIANGLES, [0.5, 0.2, 3.0], [f64::NAN, 0.0, 1.0]), None);
        assert_eq!(pick_surface(&SQUARE, &[[0, 1, 99]], [0.5, 0.2, 3.0], [0.0, 0.0, -1.0]), None);
    }

    #[test]
    fn the_shared_edge_of_two_triangles_has_no_gap() {
        for i in 0..=100 {
            let x = f64::from(i) / 100.0;
            let hit = pick_surface(&SQUARE, &TRIANGLES, [x, x, 3.0], [0.0, 0.0, -1.0]);
            assert!(hit.is_some_and(|hit| hit.distance == 3.0), "a crack at {x}");
        }
    }
}
