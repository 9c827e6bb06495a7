//! Gmsh MSH, as the Gmsh reference manual describes it (chapter "Gmsh file formats").

use std::fmt::Write as _;

use super::cursor::{Cursor, Encoding, Tags};
use crate::{MeshError, TetMesh};

/// Version of Gmsh's format.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MshVersion {
    /// Version 2.2, which nearly every program reads.
    V2_2,
    /// Version 4.1, Gmsh's own format since 2018.
    #[default]
    V4_1,
}

/// Gmsh's element type of the 4-node tetrahedron. `TET10` is the 10-node tetrahedron, whose corners
/// come first.
const TET4: i64 = 4;
const TET10: i64 = 11;

pub(super) fn parse(bytes: &[u8]) -> Result<TetMesh, MeshError> {
    let mut cursor = Cursor::new("MSH", bytes);
    let cursor = &mut cursor;
    cursor.keyword("$MeshFormat")?;
    let version = match cursor.word("version 2.2 or 4.1")?.as_str() {
        "2" | "2.0" | "2.1" | "2.2" => MshVersion::V2_2,
        "4.1" => MshVersion::V4_1,
        other => return Err(cursor.error("version 2.2 or 4.1", other)),
    };
    let binary: u8 = cursor.parse("file type 0 (text) or 1 (binary)")?;
    let data_size: u8 = cursor.parse("data size 8")?;
    if data_size != 8 {
        return Err(cursor.error("data size 8", data_size.to_string()));
    }
    // Binary data starts right after the end of a line of text.
    let mut encoding = Encoding::Text;
    if binary == 1 {
        cursor.next_line();
        encoding = match cursor.raw("the number 1 in 4 bytes")? {
            [1, 0, 0, 0] => Encoding::LittleEndian,
            [0, 0, 0, 1] => Encoding::BigEndian,
            other => return Err(cursor.error("the number 1 in 4 bytes", format!("{other:?}"))),
        };
    } else if binary != 0 {
        return Err(cursor.error("file type 0 (text) or 1 (binary)", binary.to_string()));
    }
    cursor.keyword("$EndMeshFormat")?;

    let mut nodes = None;
    let mut tets = None;
    while let Some(section) = cursor.next_word() {
        let Some(name) = section.strip_prefix('$').filter(|n| !n.starts_with("End")) else {
            return Err(cursor.error("the start of a section, $Nodes say", section));
        };
        match (name, version) {
            ("Nodes", _) if nodes.is_some() => return Err(cursor.error("one section $Nodes", "a second one")),
            ("Elements", _) if tets.is_some() => {
                return Err(cursor.error("one section $Elements", "a second one"));
            }
            ("Nodes", MshVersion::V2_2) => nodes = Some(nodes_2(cursor, encoding)?),
            ("Nodes", MshVersion::V4_1) => nodes = Some(nodes_4(cursor, encoding)?),
            ("Elements", _) => {
                let Some((_, tags)) = &nodes else {
                    return Err(cursor.error("$Nodes before $Elements", "$Elements"));
                };
                tets = Some(match version {
                    MshVersion::V2_2 => elements_2(cursor, encoding, tags)?,
                    MshVersion::V4_1 => elements_4(cursor, encoding, tags)?,
                });
            }
            _ => {
                cursor.skip_past(&format!("$End{name}"))?;
                continue;
            }
        }
        cursor.encoding = Encoding::Text;
        cursor.keyword(&format!("$End{name}"))?;
    }
    let (nodes, _) = nodes.ok_or_else(|| cursor.error("a section $Nodes", "the end of the file"))?;
    let tets = tets.ok_or_else(|| cursor.error("a section $Elements", "the end of the file"))?;
    Ok(TetMesh { nodes, tets })
}

type Nodes = (Vec<[f64; 3]>, Tags);

fn nodes_2(cursor: &mut Cursor<'_>, encoding: Encoding) -> Result<Nodes, MeshError> {
    let count = cursor.parse("the number of nodes")?;
    let count = cursor.fits(count, 8, "nodes")?;
    start(cursor, encoding);
    let mut nodes = Vec::with_capacity(count);
    let mut tags = Tags::with_capacity(count);
    for index in 0..count {
        let tag = cursor.int("a node's number")?;
        tags.insert(cursor, tag as u64, index)?;
        nodes.push(cursor.point()?);
    }
    Ok((nodes, tags))
}

fn elements_2(cursor: &mut Cursor<'_>, encoding: Encoding, tags: &Tags) -> Result<Vec<[u32; 4]>, MeshError> {
    let count = cursor.parse("the number of elements")?;
    let count = cursor.fits(count, 4, "elements")?;
    start(cursor, encoding);
    let mut tets = Vec::new();
    let mut done = 0;
    while done < count {
        // Text holds number, kind, tags and nodes of each element. Binary holds kind, number of
        // elements and number of tags each, followed by the elements.
        let (kind, group, tag_count) = if encoding == Encoding::Text {
            cursor.int("an element's number")?;
            (cursor.int("an element's kind")?, 1, cursor.int("the number of tags")?)
        } else {
            let kind = cursor.int("an element's kind")?;
            let group = cursor.int("the number of elements of this kind")?;
            (kind, group, cursor.int("the number of tags")?)
        };
        let group = cursor.fits(group as u64, 4, "elements")?;
        let tag_count = cursor.fits(tag_count as u64, 1, "tags")?;
        if group == 0 || group > count - done {
            return Err(cursor.error(format!("1 to {} more elements", count - done), group.to_string()));
        }
        for _ in 0..group {
            if encoding != Encoding::Text {
                cursor.int("an element's number")?;
            }
            for _ in 0..tag_count {
                cursor.int("a tag")?;
            }
            tet(cursor, kind, tags, &mut tets, |c| c.int("a node's number").map(|n| n as u64))?;
        }
        done += group;
    }
    Ok(tets)
}

fn nodes_4(cursor: &mut Cursor<'_>, encoding: Encoding) -> Result<Nodes, MeshError> {
    start(cursor, encoding);
    let blocks = cursor.size("the number of node blocks")?;
    let count = cursor.size("the number of nodes")?;
    let count = cursor.fits(count, 8, "nodes")?;
    cursor.size("the smallest node number")?;
    cursor.size("the largest node number")?;
    let mut nodes = Vec::with_capacity(count);
    let mut tags = Tags::with_capacity(count);
    for _ in 0..blocks {
        let dimension = cursor.int("an entity's dimension")?;
        cursor.int("an entity's tag")?;
        let parametric = cursor.int("0 or 1 for parametric")?;
        let in_block = cursor.size("the number of nodes in the block")?;
        let in_block = cursor.fits(in_block, 8, "nodes")?;
        if in_block > count - nodes.len() {
            return Err(
                cursor.error(format!("at most {} more nodes", count - nodes.len()), in_block.to_string())
            );
        }
        for index in 0..in_block {
            let tag = cursor.size("a node's number")?;
            tags.insert(cursor, tag, nodes.len() + index)?;
        }
        for _ in 0..in_block {
            nodes.push(cursor.point()?);
            for _ in 0..if parametric == 1 { dimension.clamp(0, 3) } else { 0 } {
                cursor.real("a parameter")?;
            }
        }
    }
    if nodes.len() != count {
        return Err(cursor.error(format!("{count} nodes"), nodes.len().to_string()));
    }
    Ok((nodes, tags))
}

fn elements_4(cursor: &mut Cursor<'_>, encoding: Encoding, tags: &Tags) -> Result<Vec<[u32; 4]>, MeshError> {
    start(cursor, encoding);
    let blocks = cursor.size("the number of element blocks")?;
    let count = cursor.size("the number of elements")?;
    cursor.fits(count, 4, "elements")?;
    cursor.size("the smallest element number")?;
    cursor.size("the largest element number")?;
    let mut tets = Vec::new();
    for _ in 0..blocks {
        cursor.int("an entity's dimension")?;
        cursor.int("an entity's tag")?;
        let kind = cursor.int("an element's kind")?;
        let in_block = cursor.size("the number of elements in the block")?;
        for _ in 0..cursor.fits(in_block, 4, "elements")? {
            cursor.size("an element's number")?;
            tet(cursor, kind, tags, &mut tets, |c| c.size("a node's number"))?;
        }
    }
    Ok(tets)
}

/// Reads the nodes of one element and keeps them if the element is a tetrahedron.
fn tet(
    cursor: &mut Cursor<'_>,
    kind: i64,
    tags: &Tags,
    tets: &mut Vec<[u32; 4]>,
    mut node: impl FnMut(&mut Cursor<'_>) -> Result<u64, MeshError>,
) -> Result<(), MeshError> {
    let Some(count) = node_count(kind) else {
        return Err(cursor.error("a kind of element of Gmsh's manual", kind.to_string()));
    };
    let mut corners = [0; 4];
    for i in 0..count {
        let tag = node(cursor)?;
        if let (TET4 | TET10, Some(corner)) = (kind, corners.get_mut(i)) {
            *corner = tags.index(cursor, tag)?;
        }
    }
    if let TET4 | TET10 = kind {
        tets.push(corners);
    }
    Ok(())
}

fn node_count(kind: i64) -> Option<usize> {
    const COUNTS: [usize; 31] = [
        2, 3, 4, 4, 8, 6, 5, 3, 6, 9, 10, 27, 18, 14, 1, 8, 20, 15, 13, 9, 10, 12, 15, 15, 21, 4, 5, 6, 20,
        35, 56,
    ];
    COUNTS.get(usize::try_from(kind).ok()?.checked_sub(1)?).copied()
}

fn start(cursor: &mut Cursor<'_>, encoding: Encoding) {
    if encoding != Encoding::Text {
        cursor.next_line();
        cursor.encoding = encoding;
    }
}

/// Returns the mesh as text. Reading the numbers back gives the same bits.
pub(super) fn format(mesh: &TetMesh, version: MshVersion) -> String {
    let mut text = String::with_capacity(64 * (mesh.nodes.len() + mesh.tets.len()) + 512);
    // Writing to a string cannot fail.
    let _ = write_text(&mut text, mesh, version);
    text
}

fn write_text(text: &mut String, mesh: &TetMesh, version: MshVersion) -> std::fmt::Result {
    let (nodes, tets) = (mesh.nodes.len(), mesh.tets.len());
    match version {
        MshVersion::V2_2 => {
            writeln!(text, "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{nodes}")?;
            for (tag, [x, y, z]) in (1..).zip(&mesh.nodes) {
                writeln!(text, "{tag} {x:?} {y:?} {z:?}")?;
            }
            writeln!(text, "$EndNodes\n$Elements\n{tets}")?;
            for (tag, t) in (1..).zip(&mesh.tets) {
                // The two tags are the physical and the geometrical entity 1.
                let [a, b, c, d] = t.map(|n| u64::from(n) + 1);
                writeln!(text, "{tag} {TET4} 2 1 1 {a} {b} {c} {d}")?;
            }
        }
        MshVersion::V4_1 => {
            let [[x0, y0, z0], [x1, y1, z1]] = mesh.bounds();
            writeln!(text, "$MeshFormat\n4.1 0 8\n$EndMeshFormat")?;
            writeln!(
                text,
                "$Entities\n0 0 0 1\n1 {x0:?} {y0:?} {z0:?} {x1:?} {y1:?} {z1:?} 0 0\n$EndEntities"
            )?;
            writeln!(text, "$Nodes\n1 {nodes} 1 {nodes}\n3 1 0 {nodes}")?;
            for tag in 1..=nodes {
                writeln!(text, "{tag}")?;
            }
            for [x, y, z] in &mesh.nodes {
                writeln!(text, "{x:?} {y:?} {z:?}")?;
            }
            writeln!(text, "$EndNodes\n$Elements\n1 {tets} 1 {tets}\n3 1 {TET4} {tets}")?;
            for (tag, t) in (1..).zip(&mesh.tets) {
                let [a, b, c, d] = t.map(|n| u64::from(n) + 1);
                writeln!(text, "{tag} {a} {b} {c} {d}")?;
            }
        }
    }
    writeln!(text, "$EndElements")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    /// Makes two tetrahedra and a triangle as Gmsh writes binary 4.1, with unordered node numbers.
    fn binary_4_1() -> Vec<u8> {
        let mut b = b"$MeshFormat\n4.1 1 8\n".to_vec();
        let int = |b: &mut Vec<u8>, n: i32| b.extend(n.to_le_bytes());
        let size = |b: &mut Vec<u8>, n: u64| b.extend(n.to_le_bytes());
        int(&mut b, 1);
        b.extend(b"\n$EndMeshFormat\n$Comments\nanything\n$EndComments\n$Nodes\n");
        for n in [1, 5, 3, 40] {
            size(&mut b, n);
        }
        for n in [3, 1, 0] {
            int(&mut b, n);
        }
        size(&mut b, 5);
        for tag in [40, 3, 7, 11, 20] {
            size(&mut b, tag);
        }
        for x in [0., 0., 0., 1., 0., 0., 0., 1., 0., 0., 0., 1., 1., 1., 1.] as [f64; 15] {
            b.extend(x.to_le_bytes());
        }
        b.extend(b"\n$EndNodes\n$Elements\n");
        for n in [2, 3, 1, 3] {
            size(&mut b, n);
        }
        for n in [2, 1, 2] {
            int(&mut b, n);
        }
        for n in [1, 1, 40, 3, 7] {
            size(&mut b, n);
        }
        for n in [3, 1, 4] {
            int(&mut b, n);
        }
        for n in [2, 2, 40, 3, 7, 11, 3, 3, 7, 11, 20] {
            size(&mut b, n);
        }
        b.extend(b"\n$EndElements\n");
        b
    }

    #[test]
    fn binary_4_1_with_scattered_node_numbers_is_read() {
        let mesh = parse(&binary_4_1()).unwrap();
        assert_eq!(mesh.tets, [[0, 1, 2, 3], [1, 2, 3, 4]]);
        assert_eq!(mesh.nodes[4], [1.0; 3]);
    }

    #[test]
    fn binary_2_2_is_read_in_both_byte_orders() {
        for big in [false, true] {
            let mut b = b"$MeshFormat\n2.2 1 8\n".to_vec();
            let int = |b: &mut Vec<u8>, n: i32| b.extend(if big { n.to_be_bytes() } else { n.to_le_bytes() });
            int(&mut b, 1);
            b.extend(b"\n$EndMeshFormat\n$Nodes\n4\n");
            for (tag, p) in
                (1..).zip([[0., 0., 0.], [1., 0., 0.], [0., 1., 0.], [0., 0., 1.]] as [[f64; 3]; 4])
            {
                int(&mut b, tag);
                for x in p {
                    b.extend(if big { x.to_be_bytes() } else { x.to_le_bytes() });
                }
            }
            b.extend(b"\n$EndNodes\n$Elements\n1\n");
            for n in [4, 1, 2, 1, 9, 9, 1, 2, 3, 4] {
                int(&mut b, n);
            }
            b.extend(b"\n$EndElements\n");
            assert_eq!(parse(&b).unwrap().tets, [[0, 1, 2, 3]]);
        }
    }

    #[test]
    fn text_reads_back_to_the_same_bits() {
        let mesh = shapes::sphere(5, 0.1).unwrap();
        for version in [MshVersion::V2_2, MshVersion::V4_1] {
            assert_eq!(parse(format(&mesh, version).as_bytes()).unwrap(), mesh);
        }
    }

    #[test]
    fn the_corners_of_10_node_tetrahedra_are_kept() {
        let text = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n10\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n5 .5 0 0\n6 .5 .5 0\n\
            7 0 .5 0\n8 0 0 .5\n9 0 .5 .5\n10 .5 0 .5\n$EndNodes\n$Elements\n1\n1 11 2 1 1 1 2 3 4 5 6 7 8 9 10\n$EndElements\n";
        assert_eq!(parse(text.as_bytes()).unwrap().tets, [[0, 1, 2, 3]]);
    }

    #[test]
    fn a_cut_file_is_an_error_wherever_it_is_cut() {
        let text = format(&shapes::cube(1, 1.0).unwrap(), MshVersion::V4_1);
        let whole = [text.into_bytes(), binary_4_1()];
        for bytes in &whole {
            for length in 0..bytes.len() - 1 {
                assert!(parse(&bytes[..length]).is_err(), "cut to {length} of {} bytes", bytes.len());
            }
        }
    }

    #[test]
    fn errors_name_the_line_and_what_stands_there() {
        let file = |nodes: &str, elements: &str| {
            format!(
                "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{nodes}\n$EndNodes\n$Elements\n{elements}\n$EndElements\n"
            )
        };
        let message = |text: String| parse(text.as_bytes()).unwrap_err().to_string();
        let four = "4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1";
        assert_eq!(
            message(file(four, "1\n1 4 2 1 1 1 2 3 99")),
            "MSH, line 13: expected the number of one of the 4 nodes, found 99"
        );
        assert_eq!(
            message(file("1\n1 0 NaN 0", "0")),
            "MSH, line 6: expected a finite coordinate y, found NaN"
        );
        assert!(message(file("99999999999\n1 0 0 0", "0")).contains("that the rest of the file can hold"));
        assert!(message(file("2\n1 0 0 0\n1 1 0 0", "0")).contains("node 1 twice"));
        assert!(message(file(four, "1\n1 77 0 1")).contains("kind of element"));
        assert!(message("$MeshFormat\n3.0 0 8".into()).contains("version 2.2 or 4.1, found 3.0"));
        assert!(message("v 1 2 3".into()).contains("expected $MeshFormat, found v"));
    }
}
