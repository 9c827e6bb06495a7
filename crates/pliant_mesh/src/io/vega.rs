//! Vega FEM volumetric meshes (`.veg`), text: vertices and tetrahedra. Materials and regions are
//! ignored.

use std::fmt::Write as _;

use super::cursor::{Cursor, Tags};
use crate::{MeshError, TetMesh};

pub(super) fn parse(bytes: &[u8]) -> Result<TetMesh, MeshError> {
    let mut cursor = Cursor::new("Vega", bytes).with_comments();
    let cursor = &mut cursor;
    let mut nodes = None;
    let mut tets = None;
    while let Some(word) = cursor.next_word() {
        match word.to_ascii_uppercase().as_str() {
            "*VERTICES" => {
                let count = cursor.parse("the number of vertices")?;
                let count = cursor.fits(count, 8, "vertices")?;
                let _ = (cursor.int("the dimension")?, cursor.int("0")?, cursor.int("0")?);
                let mut list = Vec::with_capacity(count);
                let mut tags = Tags::with_capacity(count);
                for index in 0..count {
                    let tag = cursor.size("a vertex's number")?;
                    tags.insert(cursor, tag, index)?;
                    list.push(cursor.point()?);
                }
                nodes = Some((list, tags));
            }
            "*ELEMENTS" => {
                let Some((_, tags)) = &nodes else {
                    return Err(cursor.error("*VERTICES before *ELEMENTS", word));
                };
                let kind = cursor.word("TET")?;
                if !matches!(kind.to_ascii_uppercase().as_str(), "TET" | "TETS") {
                    return Err(cursor.error("TET", kind));
                }
                let count = cursor.parse("the number of elements")?;
                let count = cursor.fits(count, 10, "elements")?;
                let _ = (cursor.int("the number of corners")?, cursor.int("0")?);
                let mut list = Vec::with_capacity(count);
                for _ in 0..count {
                    cursor.size("an element's number")?;
                    let mut tet = [0; 4];
                    for corner in &mut tet {
                        let tag = cursor.size("a vertex's number")?;
                        *corner = tags.index(cursor, tag)?;
                    }
                    list.push(tet);
                }
                tets = Some(list);
            }
            "*INCLUDE" => return Err(cursor.error("everything in one file", word)),
            _ => {}
        }
    }
    match (nodes, tets) {
        (Some((nodes, _)), Some(tets)) => Ok(TetMesh { nodes, tets }),
        _ => Err(cursor.error("sections *VERTICES and *ELEMENTS", "the end of the file")),
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
    writeln!(text, "*VERTICES\n{} 3 0 0", mesh.nodes.len())?;
    for (tag, [x, y, z]) in (1..).zip(&mesh.nodes) {
        writeln!(text, "{tag} {x:?} {y:?} {z:?}")?;
    }
    writeln!(text, "*ELEMENTS\nTET\n{} 4 0", mesh.tets.len())?;
    for (tag, t) in (1..).zip(&mesh.tets) {
        let [a, b, c, d] = t.map(|n| u64::from(n) + 1);
        writeln!(text, "{tag} {a} {b} {c} {d}")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_may_start_at_0_and_materials_are_passed_over() {
        let text = "# Vega\n*VERTICES\n4 3 0 0\n0 0 0 0\n1 1 0 0\n2 0 1 0\n3 0 0 1\n*ELEMENTS\nTET\n1 4 0\n0 0 1 2 3\n\
            *MATERIAL soft\nENU, 1000, 1e5, 0.45\n*REGION\nallElements, soft\n";
        assert_eq!(parse(text.as_bytes()).unwrap().tets, [[0, 1, 2, 3]]);
    }

    #[test]
    fn errors_say_what_is_wrong() {
        let message = |text: &str| parse(text.as_bytes()).unwrap_err().to_string();
        let head = "*VERTICES\n1 3 0 0\n1 0 0 0\n*ELEMENTS\n";
        assert!(message(&format!("{head}CUBIC\n1 8 0")).contains("expected TET, found CUBIC"));
        assert!(message(&format!("{head}TET\n1 4 0\n1 1 1 1 5")).contains("one of the 1 nodes, found 5"));
        assert!(message(head).contains("expected TET, found the end of the file"));
        assert!(message("*INCLUDE other.veg").contains("everything in one file"));
        assert!(message("").contains("sections *VERTICES and *ELEMENTS"));
    }
}
