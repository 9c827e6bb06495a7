//! Stanford PLY, text and binary: positions, texture coordinates and faces. Everything else is
//! ignored.

use super::cursor::{Cursor, Encoding};
use crate::{MeshError, Surface};

/// Type of a number in the file.
#[derive(Clone, Copy, PartialEq, Eq)]
enum PlyScalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

struct Property {
    name: String,
    scalar: PlyScalar,
    /// Type of the length of a list, or `None` for a single number.
    length: Option<PlyScalar>,
}

struct PlyElement {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

/// Formats positions and triangles as text.
pub(super) fn format(surface: &Surface) -> String {
    let (vertices, faces) = (surface.positions.len(), surface.triangles.len());
    let mut out = format!(
        "ply\nformat ascii 1.0\ncomment lengths in m\nelement vertex {vertices}\nproperty double x\n\
         property double y\nproperty double z\nelement face {faces}\n\
         property list uchar int vertex_indices\nend_header\n"
    );
    for [x, y, z] in &surface.positions {
        out.push_str(&format!("{x} {y} {z}\n"));
    }
    for [a, b, c] in &surface.triangles {
        out.push_str(&format!("3 {a} {b} {c}\n"));
    }
    out
}

pub(super) fn parse(bytes: &[u8]) -> Result<Surface, MeshError> {
    let mut cursor = Cursor::new("PLY", bytes);
    let cursor = &mut cursor;
    cursor.keyword("ply")?;
    let (encoding, elements) = header(cursor)?;
    cursor.next_line();
    cursor.encoding = encoding;

    let mut surface = Surface::default();
    let mut uvs = Vec::new();
    for element in &elements {
        // Each number takes at least a byte. An element without numbers takes no bytes, so no limit
        // would apply to its count.
        if element.properties.is_empty() {
            continue;
        }
        for _ in 0..cursor.fits(element.count, element.properties.len(), &element.name)? {
            match element.name.as_str() {
                "vertex" => vertex(cursor, element, &mut surface.positions, &mut uvs)?,
                "face" => face(cursor, element, &mut surface.triangles)?,
                _ => {
                    for property in &element.properties {
                        numbers(cursor, property, |_| ())?;
                    }
                }
            }
        }
    }
    if !uvs.is_empty() {
        surface.uvs = Some(uvs);
    }
    Ok(surface)
}

fn header(cursor: &mut Cursor<'_>) -> Result<(Encoding, Vec<PlyElement>), MeshError> {
    let mut encoding = None;
    let mut elements: Vec<PlyElement> = Vec::new();
    loop {
        match cursor.word("end_header")?.as_str() {
            "format" => {
                encoding =
                    Some(match cursor.word("ascii, binary_little_endian or binary_big_endian")?.as_str() {
                        "ascii" => Encoding::Text,
                        "binary_little_endian" => Encoding::LittleEndian,
                        "binary_big_endian" => Encoding::BigEndian,
                        other => {
                            return Err(
                                cursor.error("ascii, binary_little_endian or binary_big_endian", other)
                            );
                        }
                    });
                cursor.keyword("1.0")?;
            }
            "comment" | "obj_info" => {
                cursor.next_line();
            }
            "element" => {
                let name = cursor.word("an element's name")?;
                let count = cursor.parse("a count")?;
                elements.push(PlyElement { name, count, properties: Vec::new() });
            }
            "property" => {
                let kind = cursor.word("a property's type")?;
                let (length, scalar) = if kind == "list" {
                    (Some(scalar(cursor)?), scalar(cursor)?)
                } else {
                    (None, scalar_named(cursor, &kind)?)
                };
                let name = cursor.word("a property's name")?;
                match elements.last_mut() {
                    Some(element) => element.properties.push(Property { name, scalar, length }),
                    None => return Err(cursor.error("an element before its properties", name)),
                }
            }
            "end_header" => break,
            other => return Err(cursor.error("format, element, property or end_header", other)),
        }
    }
    match encoding {
        Some(encoding) => Ok((encoding, elements)),
        None => Err(cursor.error("a line with the format", "end_header")),
    }
}

fn vertex(
    cursor: &mut Cursor<'_>,
    element: &PlyElement,
    positions: &mut Vec<[f64; 3]>,
    uvs: &mut Vec<[f32; 2]>,
) -> Result<(), MeshError> {
    let mut position = [None; 3];
    let mut uv = [None; 2];
    for property in &element.properties {
        numbers(cursor, property, |x| match property.name.as_str() {
            "x" => position[0] = Some(x),
            "y" => position[1] = Some(x),
            "z" => position[2] = Some(x),
            "u" | "s" | "texture_u" => uv[0] = Some(x as f32),
            "v" | "t" | "texture_v" => uv[1] = Some(x as f32),
            _ => {}
        })?;
    }
    let [Some(x), Some(y), Some(z)] = position else {
        return Err(cursor.error("vertices with properties x, y and z", "a vertex without them"));
    };
    positions.push([x, y, z]);
    if let [Some(u), Some(v)] = uv {
        uvs.push([u, v]);
    }
    Ok(())
}

fn face(
    cursor: &mut Cursor<'_>,
    element: &PlyElement,
    triangles: &mut Vec<[u32; 3]>,
) -> Result<(), MeshError> {
    let mut corners: Vec<u32> = Vec::new();
    let mut wrong = None;
    for property in &element.properties {
        let corner =
            matches!(property.name.as_str(), "vertex_indices" | "vertex_index") && property.length.is_some();
        numbers(cursor, property, |x| {
            if corner {
                if x >= 0.0 && x < f64::from(u32::MAX) { corners.push(x as u32) } else { wrong = Some(x) }
            }
        })?;
    }
    if let Some(x) = wrong {
        return Err(cursor.error("a vertex's number", x.to_string()));
    }
    if corners.len() < 3 {
        return Err(cursor.error("a face of at least three corners", corners.len().to_string()));
    }
    triangles.extend(corners.windows(2).skip(1).map(|w| [corners[0], w[0], w[1]]));
    Ok(())
}

/// Reads the number of a property, or all numbers of its list.
fn numbers(cursor: &mut Cursor<'_>, property: &Property, mut take: impl FnMut(f64)) -> Result<(), MeshError> {
    let count = match property.length {
        None => 1,
        Some(length) => {
            let length = number(cursor, length)?;
            let whole = length >= 0.0 && length.fract() == 0.0;
            cursor.fits(if whole { length as u64 } else { u64::MAX }, 1, "numbers")?
        }
    };
    for _ in 0..count {
        take(number(cursor, property.scalar)?);
    }
    Ok(())
}

fn number(cursor: &mut Cursor<'_>, scalar: PlyScalar) -> Result<f64, MeshError> {
    const NUMBER: &str = "number";
    if cursor.encoding == Encoding::Text || scalar == PlyScalar::F64 {
        return cursor.real(NUMBER);
    }
    let big = cursor.encoding == Encoding::BigEndian;
    let whole = |bytes: [u8; 2]| if big { u16::from_be_bytes(bytes) } else { u16::from_le_bytes(bytes) };
    Ok(match scalar {
        PlyScalar::I8 => f64::from(i8::from_le_bytes(cursor.raw(NUMBER)?)),
        PlyScalar::U8 => f64::from(u8::from_le_bytes(cursor.raw(NUMBER)?)),
        PlyScalar::I16 => f64::from(whole(cursor.raw(NUMBER)?) as i16),
        PlyScalar::U16 => f64::from(whole(cursor.raw(NUMBER)?)),
        PlyScalar::I32 => cursor.int(NUMBER)? as f64,
        PlyScalar::U32 => f64::from(cursor.int(NUMBER)? as u32),
        PlyScalar::F32 | PlyScalar::F64 => cursor.short_real(NUMBER)?,
    })
}

fn scalar(cursor: &mut Cursor<'_>) -> Result<PlyScalar, MeshError> {
    let name = cursor.word("a type of number")?;
    scalar_named(cursor, &name)
}

fn scalar_named(cursor: &Cursor<'_>, name: &str) -> Result<PlyScalar, MeshError> {
    Ok(match name {
        "char" | "int8" => PlyScalar::I8,
        "uchar" | "uint8" => PlyScalar::U8,
        "short" | "int16" => PlyScalar::I16,
        "ushort" | "uint16" => PlyScalar::U16,
        "int" | "int32" => PlyScalar::I32,
        "uint" | "uint32" => PlyScalar::U32,
        "float" | "float32" => PlyScalar::F32,
        "double" | "float64" => PlyScalar::F64,
        other => return Err(cursor.error("a type of number", other)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_and_binary_give_the_same_surface() {
        let head = |format: &str| {
            format!(
                "ply\nformat {format} 1.0\ncomment by hand\nelement vertex 4\nproperty float x\nproperty double y\n\
                 property float z\nproperty uchar red\nelement edge 1\nproperty short vertex1\n\
                 element face 1\nproperty list uchar int vertex_indices\nend_header\n"
            )
        };
        let points = [[0.0, 0.0, 0.5], [1.0, 0.0, 0.5], [1.0, 1.0, 0.5], [0.0, 1.0, 0.5]];
        let text = head("ascii") + "0 0 .5 9\n1 0 .5 9\n1 1 .5 9\n0 1 .5 9\n3\n4 0 1 2 3\n";
        let surface = parse(text.as_bytes()).unwrap();
        assert_eq!(surface.positions, points);
        assert_eq!(surface.triangles, [[0, 1, 2], [0, 2, 3]]);
        for big in [false, true] {
            let mut b = head(if big { "binary_big_endian" } else { "binary_little_endian" }).into_bytes();
            let order = |mut bytes: Vec<u8>| {
                if big {
                    bytes.reverse();
                }
                bytes
            };
            for [x, y, z] in points {
                b.extend(order((x as f32).to_le_bytes().to_vec()));
                b.extend(order(y.to_le_bytes().to_vec()));
                b.extend(order((z as f32).to_le_bytes().to_vec()));
                b.push(9);
            }
            b.extend(order(3_i16.to_le_bytes().to_vec()));
            b.push(4);
            for n in 0..4_i32 {
                b.extend(order(n.to_le_bytes().to_vec()));
            }
            assert_eq!(parse(&b).unwrap(), surface);
            assert!(parse(&b[..b.len() - 1]).unwrap_err().to_string().contains("found the end of the file"));
        }
    }

    #[test]
    fn errors_say_what_is_wrong() {
        let message = |text: &str| parse(text.as_bytes()).unwrap_err().to_string();
        let head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n";
        assert!(message(&format!("{head}end_header\n1 2\n")).contains("vertices with properties x, y and z"));
        assert!(message("ply\nformat ascii 2.0\n").contains("expected 1.0, found 2.0"));
        assert!(
            message("ply\nelement vertex 99999999999999\nproperty float x\nformat ascii 1.0\nend_header\n1")
                .contains("can hold")
        );
        assert!(message("ply\nproperty float x\n").contains("an element before"));
        assert!(message("ply\nend_header\n").contains("a line with the format"));
        let faces =
            "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n";
        assert!(message(&format!("{faces}2 0 1\n")).contains("at least three corners, found 2"));
        assert!(message(&format!("{faces}3 0 1 -1\n")).contains("a vertex's number, found -1"));
        assert!(message(&format!("{faces}1e18 0 1 2\n")).contains("can hold"));
    }
}
