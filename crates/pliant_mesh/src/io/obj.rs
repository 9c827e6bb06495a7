//! Wavefront OBJ: positions, texture coordinates and faces. Everything else is ignored.

use std::collections::HashMap;

use super::cursor::{Cursor, parse_error};
use crate::{MeshError, Place, Surface};

pub(super) fn parse(bytes: &[u8]) -> Result<Surface, MeshError> {
    let mut cursor = Cursor::new("OBJ", bytes);
    let mut positions: Vec<[f64; 3]> = Vec::new();
    let mut uvs: Vec<[f32; 2]> = Vec::new();
    // Corners are (position, texture coordinate) pairs, three per triangle.
    let mut corners: Vec<(u32, Option<u32>)> = Vec::new();
    let mut polygon = Vec::new();
    loop {
        let number = cursor.line();
        let Some(mut line) = cursor.next_line() else { break };
        while line.ends_with('\\') {
            line.pop();
            match cursor.next_line() {
                Some(more) => line.push_str(&more),
                None => break,
            }
        }
        let error = |expected: &str, found: &str| parse_error("OBJ", Place::Line(number), expected, found);
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("v") => {
                positions.push(numbers(words).ok_or_else(|| error("v x y z, finite numbers", &line))?)
            }
            Some("vt") => {
                uvs.push(
                    numbers(words).ok_or_else(|| error("vt u v, finite numbers", &line))?.map(|x| x as f32),
                );
            }
            Some("f") => {
                polygon.clear();
                for word in words.take_while(|w| !w.starts_with('#')) {
                    polygon.push(corner(word, positions.len(), uvs.len()).ok_or_else(|| {
                        let counts =
                            format!("{} positions and {} texture coordinates", positions.len(), uvs.len());
                        error(&format!("the numbers of some of the {counts} so far"), word)
                    })?);
                }
                if polygon.len() < 3 {
                    return Err(error("a face of at least three corners, f v1 v2 v3", &line));
                }
                for i in 2..polygon.len() {
                    corners.extend([polygon[0], polygon[i - 1], polygon[i]]);
                }
            }
            _ => {}
        }
    }
    Ok(surface(&positions, &uvs, &corners))
}

/// Makes one vertex for each used pair of position and texture coordinate, in order of first use.
fn surface(positions: &[[f64; 3]], uvs: &[[f32; 2]], corners: &[(u32, Option<u32>)]) -> Surface {
    let textured = !corners.is_empty() && corners.iter().all(|c| c.1.is_some());
    let mut vertex_of = HashMap::new();
    let mut surface = Surface { uvs: textured.then(Vec::new), ..Surface::default() };
    let vertices: Vec<u32> = corners
        .iter()
        .map(|&(position, uv)| {
            *vertex_of.entry((position, uv.filter(|_| textured))).or_insert_with(|| {
                surface.positions.push(positions[position as usize]);
                if let (Some(list), Some(uv)) = (&mut surface.uvs, uv) {
                    list.push(uvs[uv as usize]);
                }
                surface.positions.len() as u32 - 1
            })
        })
        .collect();
    surface.triangles = vertices.as_chunks::<3>().0.to_vec();
    surface
}

fn numbers<'a, const N: usize>(mut words: impl Iterator<Item = &'a str>) -> Option<[f64; N]> {
    let mut numbers = [0.0; N];
    for number in &mut numbers {
        *number = words.next()?.parse().ok().filter(|x: &f64| x.is_finite())?;
    }
    Some(numbers)
}

/// Parses `v`, `v/vt`, `v/vt/vn` or `v//vn`. Numbers count from 1, and negative numbers count back
/// from the last.
fn corner(word: &str, position_count: usize, uv_count: usize) -> Option<(u32, Option<u32>)> {
    let index = |text: &str, count: usize| {
        let number: i64 = text.parse().ok()?;
        let index = if number < 0 { number.checked_add(count as i64)? } else { number - 1 };
        (0..count as i64).contains(&index).then_some(index as u32)
    };
    let mut parts = word.split('/');
    let position = index(parts.next()?, position_count)?;
    let uv = match parts.next() {
        None | Some("") => None,
        Some(text) => Some(index(text, uv_count)?),
    };
    Some((position, uv))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polygons_become_fans_and_numbers_may_count_back() {
        let surface = parse(b"# quad\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf -4 2 \\\n 3//7 4\n").unwrap();
        assert_eq!(surface.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(surface.uvs, None);
    }

    #[test]
    fn a_vertex_on_a_texture_seam_is_split() {
        let text =
            "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\nf 1/2 3/3 4/1\n";
        let surface = parse(text.as_bytes()).unwrap();
        assert_eq!(surface.positions.len(), 5);
        assert_eq!(surface.triangles, [[0, 1, 2], [3, 2, 4]]);
        assert_eq!(surface.positions[3], surface.positions[0]);
        assert_eq!(surface.uvs.unwrap()[3], [1.0, 0.0]);
    }

    #[test]
    fn errors_name_the_line_and_what_stands_there() {
        let message = |text: &str| parse(text.as_bytes()).unwrap_err().to_string();
        assert_eq!(message("v 0 0 0\nv 1 2"), "OBJ, line 2: expected v x y z, finite numbers, found v 1 2");
        assert!(message("v 0 inf 0").contains("finite"));
        assert!(
            message("v 0 0 0\nv 1 0 0\nf 1 2").contains("line 3: expected a face of at least three corners")
        );
        assert!(
            message("v 0 0 0\nf 1 1 4000000000")
                .contains("1 positions and 0 texture coordinates so far, found 4000000000")
        );
        assert!(message("v 0 0 0\nf 1 1 0").contains("found 0"));
        assert!(message("v 0 0 0\nf 1 1 -9223372036854775808").contains("so far"));
    }
}
