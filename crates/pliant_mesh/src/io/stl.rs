//! STL, text and binary, read by `stl_io`. Equal corners become one vertex.

use std::io::Cursor;

use super::cursor::parse_error;
use crate::{MeshError, Place, Surface};

pub(super) fn parse(bytes: &[u8]) -> Result<Surface, MeshError> {
    let mut reader = Cursor::new(bytes);
    let mesh = stl_io::read_stl(&mut reader).map_err(|error| {
        let place = Place::Byte(reader.position() as usize);
        parse_error("STL", place, "triangles as text or in 50 bytes each", error.to_string())
    })?;
    Ok(Surface {
        positions: mesh.vertices.iter().map(|v| v.0.map(f64::from)).collect(),
        triangles: mesh.faces.iter().map(|f| f.vertices.map(|v| v as u32)).collect(),
        uvs: None,
    })
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
    fn text_is_read() {
        let text = "solid one\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid one\n";
        assert_eq!(parse(text.as_bytes()).unwrap().triangles, [[0, 1, 2]]);
        assert!(parse(&text.as_bytes()[..60]).is_err());
    }
}
