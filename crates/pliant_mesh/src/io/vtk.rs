//! VTK legacy format, unstructured grids (versions up to 4.2, and 5.1 with its offsets).

use std::fmt::Write as _;

use super::cursor::{Cursor, Encoding};
use crate::{MeshError, TetMesh};

/// VTK's cell type of the 4-node tetrahedron. The 10-node tetrahedron follows, and its corners come
/// first.
const TETRA: i64 = 10;
const QUADRATIC_TETRA: i64 = 24;

pub(super) fn parse(bytes: &[u8]) -> Result<TetMesh, MeshError> {
    let mut cursor = Cursor::new("VTK", bytes);
    let cursor = &mut cursor;
    let header = cursor.next_line().unwrap_or_default();
    if !header.starts_with("# vtk DataFile Version") {
        return Err(cursor.error("# vtk DataFile Version", header));
    }
    // The title may be any text.
    cursor.next_line();
    let encoding = match cursor.word("ASCII or BINARY")?.as_str() {
        "ASCII" => Encoding::Text,
        "BINARY" => Encoding::BigEndian,
        other => return Err(cursor.error("ASCII or BINARY", other)),
    };
    cursor.keyword("DATASET")?;
    cursor.keyword("UNSTRUCTURED_GRID")?;

    let (mut nodes, mut cells, mut kinds) = (None, None, None);
    while let Some(word) = cursor.next_word() {
        match word.as_str() {
            "POINTS" => nodes = Some(points(cursor, encoding)?),
            "CELLS" => cells = Some(connectivity(cursor, encoding)?),
            "CELL_TYPES" => {
                let count = cursor.parse("the number of cells")?;
                let count = cursor.fits(count, 2, "cells")?;
                begin(cursor, encoding);
                kinds = Some((0..count).map(|_| cursor.int("a cell's type")).collect::<Result<Vec<_>, _>>()?);
            }
            "FIELD" | "METADATA" if kinds.is_none() => {
                return Err(cursor.error("POINTS, CELLS and CELL_TYPES before anything else", word));
            }
            // Data on points and cells comes last.
            _ => break,
        }
        cursor.encoding = Encoding::Text;
        if let (Some(nodes), Some(cells), Some(kinds)) = (&nodes, &cells, &kinds) {
            return mesh(cursor, nodes, cells, kinds);
        }
    }
    Err(cursor.error("sections POINTS, CELLS and CELL_TYPES", "the end of the file"))
}

fn mesh(
    cursor: &Cursor<'_>,
    nodes: &[[f64; 3]],
    cells: &[Vec<u64>],
    kinds: &[i64],
) -> Result<TetMesh, MeshError> {
    if cells.len() != kinds.len() {
        return Err(cursor.error(format!("{} cell types", cells.len()), kinds.len().to_string()));
    }
    let mut mesh = TetMesh { nodes: nodes.to_vec(), tets: Vec::new() };
    for (cell, kind) in cells.iter().zip(kinds) {
        if !matches!(*kind, TETRA | QUADRATIC_TETRA) {
            continue;
        }
        let Some(corners) = cell.first_chunk::<4>() else {
            return Err(cursor.error("at least four corners of a tetrahedron", cell.len().to_string()));
        };
        if let Some(&index) = corners.iter().find(|&&n| n >= nodes.len() as u64) {
            let element = mesh.tets.len();
            return Err(MeshError::Index { what: "tetrahedron", element, index, count: nodes.len() });
        }
        mesh.tets.push(corners.map(|n| n as u32));
    }
    Ok(mesh)
}

fn points(cursor: &mut Cursor<'_>, encoding: Encoding) -> Result<Vec<[f64; 3]>, MeshError> {
    let count = cursor.parse("the number of points")?;
    let count = cursor.fits(count, 6, "points")?;
    let short = match cursor.word("float or double")?.as_str() {
        "float" => true,
        "double" => false,
        other => return Err(cursor.error("float or double", other)),
    };
    begin(cursor, encoding);
    let mut nodes = Vec::with_capacity(count);
    for _ in 0..count {
        let mut point = [0.0; 3];
        for x in &mut point {
            *x = if short { cursor.short_real("coordinate")? } else { cursor.real("coordinate")? };
        }
        nodes.push(point);
    }
    Ok(nodes)
}

/// Reads the nodes of each cell.
fn connectivity(cursor: &mut Cursor<'_>, encoding: Encoding) -> Result<Vec<Vec<u64>>, MeshError> {
    let first: u64 = cursor.parse("the number of cells")?;
    let second: u64 = cursor.parse("the size of the list")?;
    let first = cursor.fits(first, 2, "cells")?;
    let second = cursor.fits(second, 2, "numbers")?;
    let line = cursor.next_line().unwrap_or_default();
    if !line.trim().is_empty() {
        return Err(cursor.error("the end of the line", line));
    }
    if cursor.peek_word().as_deref() == Some("OFFSETS") {
        // Version 5.1 lists the start of each cell and the end of the last one, followed by all
        // nodes.
        let offsets = list(cursor, encoding, "OFFSETS", first)?;
        let nodes = list(cursor, encoding, "CONNECTIVITY", second)?;
        return offsets
            .windows(2)
            .map(|w| {
                let range = w[0] as usize..w[1] as usize;
                let cell = nodes.get(range).map(<[u64]>::to_vec);
                cell.ok_or_else(|| cursor.error(format!("offsets up to {second}"), format!("{w:?}")))
            })
            .collect();
    }
    cursor.encoding = encoding;
    let mut cells = Vec::with_capacity(first);
    for _ in 0..first {
        let count = cursor.int("the number of nodes of a cell")?;
        let count = cursor.fits(count as u64, 2, "nodes")?;
        let nodes = (0..count).map(|_| cursor.int("a node").map(|n| n as u64));
        cells.push(nodes.collect::<Result<Vec<_>, _>>()?);
    }
    Ok(cells)
}

fn list(
    cursor: &mut Cursor<'_>,
    encoding: Encoding,
    name: &str,
    count: usize,
) -> Result<Vec<u64>, MeshError> {
    cursor.keyword(name)?;
    let wide = match cursor.word("vtktypeint64 or vtktypeint32")?.as_str() {
        "vtktypeint64" => true,
        "vtktypeint32" => false,
        other => return Err(cursor.error("vtktypeint64 or vtktypeint32", other)),
    };
    begin(cursor, encoding);
    let numbers = (0..count)
        .map(|_| if wide { cursor.size("a number") } else { cursor.int("a number").map(|n| n as u64) });
    let numbers = numbers.collect();
    cursor.encoding = Encoding::Text;
    numbers
}

fn begin(cursor: &mut Cursor<'_>, encoding: Encoding) {
    cursor.next_line();
    cursor.encoding = encoding;
}

/// Returns the mesh as text, version 3.0. Reading the numbers back gives the same bits.
pub(super) fn format(mesh: &TetMesh) -> String {
    let mut text = String::with_capacity(64 * (mesh.nodes.len() + mesh.tets.len()) + 512);
    // Writing to a string cannot fail.
    let _ = write_text(&mut text, mesh);
    text
}

fn write_text(text: &mut String, mesh: &TetMesh) -> std::fmt::Result {
    let (nodes, tets) = (mesh.nodes.len(), mesh.tets.len());
    writeln!(
        text,
        "# vtk DataFile Version 3.0\ntetrahedra\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {nodes} double"
    )?;
    for [x, y, z] in &mesh.nodes {
        writeln!(text, "{x:?} {y:?} {z:?}")?;
    }
    writeln!(text, "CELLS {tets} {}", 5 * tets)?;
    for [a, b, c, d] in &mesh.tets {
        writeln!(text, "4 {a} {b} {c} {d}")?;
    }
    writeln!(text, "CELL_TYPES {tets}")?;
    for _ in &mesh.tets {
        writeln!(text, "{TETRA}")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn binary_and_version_5_1_are_read() {
        let points: [f32; 12] = [0., 0., 0., 1., 0., 0., 0., 1., 0., 0., 0., 1.];
        let mut old =
            b"# vtk DataFile Version 3.0\nany title\nBINARY\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n"
                .to_vec();
        old.extend(points.iter().flat_map(|x| x.to_be_bytes()));
        old.extend(b"\nCELLS 2 8\n");
        old.extend([2_i32, 0, 1, 4, 0, 1, 2, 3].iter().flat_map(|n| n.to_be_bytes()));
        old.extend(b"\nCELL_TYPES 2\n");
        old.extend([3_i32, 10].iter().flat_map(|n| n.to_be_bytes()));
        let mesh = parse(&old).unwrap();
        assert_eq!(mesh.tets, [[0, 1, 2, 3]]);
        assert_eq!(mesh.nodes[3], [0.0, 0.0, 1.0]);

        let new = "# vtk DataFile Version 5.1\nt\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n0 0 0 1 0 0 0 1 0 0 0 1\n\
            CELLS 3 6\nOFFSETS vtktypeint64\n0 2 6\nCONNECTIVITY vtktypeint64\n0 1 0 1 2 3\nCELL_TYPES 2\n3\n10\n";
        assert_eq!(parse(new.as_bytes()).unwrap(), mesh);
    }

    #[test]
    fn errors_say_what_is_wrong() {
        let file = |cells: &str| {
            let head =
                "# vtk DataFile Version 3.0\nt\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 1 float\n0 0 0\n";
            parse(format!("{head}{cells}").as_bytes()).unwrap_err().to_string()
        };
        assert!(file("CELLS 1 5\n4 0 0 0 9\nCELL_TYPES 1\n10\n").contains("node indices below 1, found 9"));
        assert!(file("CELLS 1 5\n4 0 0 0 -1\nCELL_TYPES 1\n10\n").contains("node indices below 1"));
        assert!(file("CELLS 1 3\n2 0 0\nCELL_TYPES 1\n10\n").contains("four corners"));
        assert!(file("CELLS 99999999999 5\n").contains("can hold"));
        assert!(file("").contains("sections POINTS, CELLS and CELL_TYPES"));
    }
}
