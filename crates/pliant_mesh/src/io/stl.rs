//! STL, text and binary. Equal corners become one vertex.

use super::cursor::{Cursor, Encoding};
use crate::{MeshError, Surface};

/// Header size of a binary file: 80 arbitrary bytes and the number of triangles. Each triangle
/// takes 50 bytes.
const HEADER: usize = 84;
const TRIANGLE: usize = 50;

pub(super) fn parse(bytes: &[u8]) -> Result<Surface, MeshError> {
    let mut cursor = Cursor::new("STL", bytes);
    // Many binary files start with the keyword of the text format, so the size decides.
    let count = bytes.get(80..HEADER).and_then(|b| b.first_chunk()).map(|b| u32::from_le_bytes(*b) as usize);
    let binary = count.is_some_and(|n| bytes.len() == HEADER + n * TRIANGLE);
    let corners = if binary || !bytes.trim_ascii_start().starts_with(b"solid") {
        binary_corners(&mut cursor)?
    } else {
        text_corners(&mut cursor)?
    };
    let triangles = (0..corners.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    Ok(Surface { positions: corners, triangles, uvs: None }.merged())
}

fn binary_corners(cursor: &mut Cursor<'_>) -> Result<Vec<[f64; 3]>, MeshError> {
    cursor.encoding = Encoding::LittleEndian;
    cursor.raw::<80>("a header of 80 bytes")?;
    let count = cursor.int("the number of triangles")? as u32;
    let count = cursor.fits(u64::from(count), TRIANGLE, "triangles")?;
    let mut corners = Vec::with_capacity(3 * count);
    for _ in 0..count {
        cursor.raw::<12>("a normal")?;
        for _ in 0..3 {
            let mut corner = [0.0; 3];
            for x in &mut corner {
                *x = cursor.short_real("coordinate")?;
            }
            corners.push(corner);
        }
        cursor.raw::<2>("two bytes after a triangle")?;
    }
    Ok(corners)
}

fn text_corners(cursor: &mut Cursor<'_>) -> Result<Vec<[f64; 3]>, MeshError> {
    let mut corners = Vec::new();
    // The file may hold several solids, each with any name.
    while let Some(word) = cursor.next_word() {
        if word != "solid" {
            return Err(cursor.error("solid", word));
        }
        cursor.next_line();
        loop {
            match cursor.word("facet or endsolid")?.as_str() {
                "facet" => {}
                "endsolid" => break,
                other => return Err(cursor.error("facet or endsolid", other)),
            }
            cursor.keyword("normal")?;
            for _ in 0..3 {
                // The corners determine the normal. Many files hold wrong values here.
                cursor.word("a normal")?;
            }
            cursor.keyword("outer")?;
            cursor.keyword("loop")?;
            for _ in 0..3 {
                cursor.keyword("vertex")?;
                corners.push(cursor.point()?);
            }
            cursor.keyword("endloop")?;
            cursor.keyword("endfacet")?;
        }
        cursor.next_line();
    }
    Ok(corners)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    #[test]
    fn a_binary_ball_is_read_closed_and_a_cut_one_is_refused() {
        let (ball, _) = shapes::sphere(3, 1.0).unwrap().boundary();
        let mut b = vec![0; 80];
        b.extend((ball.triangles.len() as u32).to_le_bytes());
        for t in &ball.triangles {
            b.extend([0; 12]);
            for p in t.map(|v| ball.positions[v as usize]) {
                b.extend(p.iter().flat_map(|&x| (x as f32).to_le_bytes()));
            }
            b.extend([0; 2]);
        }
        let read = parse(&b).unwrap();
        assert_eq!(read.positions.len(), ball.positions.len());
        assert!((read.closed().unwrap().volume() / ball.volume() - 1.0).abs() < 1e-6, "f32 has 7 digits");
        for cut in [b.len() - 1, 84, 83, 10, 0] {
            assert!(matches!(parse(&b[..cut]), Err(MeshError::Parse { .. })), "cut to {cut}");
        }
    }

    #[test]
    fn text_is_read_with_names_and_without_and_cut_text_is_refused() {
        let facet =
            "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n";
        let text = format!("solid\n{facet}{facet}endsolid\nsolid one more\n{facet}endsolid one more\n");
        let surface = parse(text.as_bytes()).unwrap();
        assert_eq!(surface.triangles, [[0, 1, 2]; 3]);
        assert_eq!(surface.positions.len(), 3);
        let message = |text: &str| parse(text.as_bytes()).unwrap_err().to_string();
        assert_eq!(message(&text[..42]), "STL, line 4: expected coordinate x, found the end of the file");
        assert!(
            message("solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 NaN")
                .contains("a finite coordinate z")
        );
        assert!(message("solid\nmesh").contains("facet or endsolid, found mesh"));
    }
}
