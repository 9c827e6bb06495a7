//! INRIA's Medit format (`.mesh`), text.

use std::fmt::Write as _;

use super::cursor::Cursor;
use crate::{MeshError, TetMesh};

pub(super) fn parse(bytes: &[u8]) -> Result<TetMesh, MeshError> {
    let mut cursor = Cursor::new("Medit", bytes).with_comments();
    let cursor = &mut cursor;
    cursor.keyword("MeshVersionFormatted")?;
    cursor.parse::<u8>("a version")?;
    let mut nodes = None;
    let mut tets = None;
    while let Some(word) = cursor.next_word() {
        match word.as_str() {
            "Dimension" => {
                let dimension: u8 = cursor.parse("dimension 3")?;
                if dimension != 3 {
                    return Err(cursor.error("dimension 3", dimension.to_string()));
                }
            }
            "Vertices" => {
                let count = cursor.parse("the number of vertices")?;
                let count = cursor.fits(count, 8, "vertices")?;
                let mut list = Vec::with_capacity(count);
                for _ in 0..count {
                    list.push(cursor.point()?);
                    cursor.int("a reference")?;
                }
                nodes = Some(list);
            }
            "Tetrahedra" => {
                let Some(nodes) = &nodes else {
                    return Err(cursor.error("Vertices before Tetrahedra", word));
                };
                let count = cursor.parse("the number of tetrahedra")?;
                let count = cursor.fits(count, 10, "tetrahedra")?;
                let mut list = Vec::with_capacity(count);
                for _ in 0..count {
                    let mut tet = [0; 4];
                    for corner in &mut tet {
                        // Vertex numbers count from 1.
                        let number: u64 = cursor.parse("a vertex")?;
                        if !(1..=nodes.len() as u64).contains(&number) {
                            return Err(cursor
                                .error(format!("a vertex from 1 to {}", nodes.len()), number.to_string()));
                        }
                        *corner = (number - 1) as u32;
                    }
                    cursor.int("a reference")?;
                    list.push(tet);
                }
                tets = Some(list);
            }
            "End" => break,
            // Other sections and their numbers are ignored.
            _ => {}
        }
    }
    match (nodes, tets) {
        (Some(nodes), Some(tets)) => Ok(TetMesh { nodes, tets }),
        _ => Err(cursor.error("sections Vertices and Tetrahedra", "the end of the file")),
    }
}

/// Returns the mesh as text. Reading the numbers back gives the same bits.
pub(super) fn format(mesh: &TetMesh) -> String {
    let mut text = String::with_capacity(64 * (mesh.nodes.len() + mesh.tets.len()) + 512);
    // Writing to a string cannot fail.
    let _ = write_text(&mut text, mesh);
    text
}

fn write_text(text: &mut String, mesh: &TetMesh) -> std::fmt::Result {
    writeln!(text, "MeshVersionFormatted 2\nDimension 3\nVertices\n{}", mesh.nodes.len())?;
    for [x, y, z] in &mesh.nodes {
        writeln!(text, "{x:?} {y:?} {z:?} 0")?;
    }
    writeln!(text, "Tetrahedra\n{}", mesh.tets.len())?;
    for t in &mesh.tets {
        let [a, b, c, d] = t.map(|n| u64::from(n) + 1);
        writeln!(text, "{a} {b} {c} {d} 0")?;
    }
    writeln!(text, "End")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_sections_and_comments_are_passed_over() {
        let text = "MeshVersionFormatted 1 # old\nDimension\n3\nVertices\n4\n0 0 0 7\n1 0 0 7\n0 1 0 7\n0 0 1 7\n\
            Triangles\n1\n1 2 3 5\nTetrahedra 1\n1 2 3 4 1\nEnd\n";
        assert_eq!(parse(text.as_bytes()).unwrap().tets, [[0, 1, 2, 3]]);
    }

    #[test]
    fn errors_say_what_is_wrong() {
        let message = |text: &str| parse(text.as_bytes()).unwrap_err().to_string();
        let head = "MeshVersionFormatted 2\nDimension 3\nVertices\n1\n0 0 0 0\n";
        assert_eq!(
            message(&format!("{head}Tetrahedra\n1\n1 1 1 2 0")),
            "Medit, line 8: expected a vertex from 1 to 1, found 2"
        );
        assert!(message(&format!("{head}Tetrahedra\n1\n1 1 1 0 0")).contains("found 0"));
        assert!(message(&format!("{head}Tetrahedra\n2\n1 1 1 1 0")).contains("found the end of the file"));
        assert!(message(head).contains("sections Vertices and Tetrahedra"));
        assert!(message("MeshVersionFormatted 2\nDimension 2").contains("dimension 3"));
    }
}
