//! glTF 2.0, `.gltf` and `.glb`: the triangles of the default scene (else of all scenes), placed by their nodes.

use std::path::{Component, Path};

use ::gltf::{
    Accessor, Gltf, Node,
    accessor::{DataType, Dimensions},
    buffer::Source,
    mesh::Mode,
};
use nalgebra::{Matrix4, Point3};

use super::cursor::parse_error;
use crate::{MeshError, Place, Surface};

/// Deeper trees of nodes are refused: they may be rings.
const DEEPEST: usize = 200;
/// More placed meshes than this are refused: nodes may share children, and their number grow without bound.
const MAX_PRIMITIVES: usize = 100_000;

/// `folder` is where files that the glTF names are looked for.
pub(super) fn parse(bytes: &[u8], folder: &Path) -> Result<Surface, MeshError> {
    let gltf = Gltf::from_slice(bytes).map_err(|e| wrong("a glTF 2.0 document", e.to_string()))?;
    let mut reader = Reader {
        buffers: buffers(&gltf, folder)?,
        surface: Surface::default(),
        uvs: Some(Vec::new()),
        primitives: 0,
    };
    let scenes: Vec<_> = gltf.default_scene().map_or_else(|| gltf.scenes().collect(), |scene| vec![scene]);
    for node in scenes.iter().flat_map(|scene| scene.nodes()) {
        reader.node(&node, Matrix4::identity(), 0)?;
    }
    reader.surface.uvs = reader.uvs.filter(|uvs| !uvs.is_empty());
    Ok(reader.surface)
}

struct Reader {
    buffers: Vec<Vec<u8>>,
    surface: Surface,
    /// Given up when a mesh has none.
    uvs: Option<Vec<[f32; 2]>>,
    primitives: usize,
}

impl Reader {
    fn node(&mut self, node: &Node<'_>, parent: Matrix4<f64>, depth: usize) -> Result<(), MeshError> {
        if depth > DEEPEST {
            return Err(wrong("a tree of nodes", "nodes that are their own children, or a very deep tree"));
        }
        let place = parent * Matrix4::from(node.transform().matrix()).cast::<f64>();
        for primitive in node.mesh().iter().flat_map(|mesh| mesh.primitives()) {
            if primitive.mode() == Mode::Triangles {
                self.triangles(&primitive, place)?;
            } else if !matches!(
                primitive.mode(),
                Mode::Points | Mode::Lines | Mode::LineLoop | Mode::LineStrip
            ) {
                return Err(wrong("lists of triangles", format!("{:?}", primitive.mode())));
            }
        }
        for child in node.children() {
            self.node(&child, place, depth + 1)?;
        }
        Ok(())
    }

    fn triangles(&mut self, primitive: &::gltf::Primitive<'_>, place: Matrix4<f64>) -> Result<(), MeshError> {
        self.primitives += 1;
        if self.primitives > MAX_PRIMITIVES {
            return Err(wrong(format!("at most {MAX_PRIMITIVES} placed meshes"), "more"));
        }
        let positions = primitive
            .get(&::gltf::Semantic::Positions)
            .ok_or_else(|| wrong("a mesh with positions", "one without"))?;
        let positions: Vec<[f32; 3]> = self.floats(&positions, Dimensions::Vec3)?;
        let uvs = match primitive.get(&::gltf::Semantic::TexCoords(0)) {
            Some(uvs) if uvs.data_type() == DataType::F32 => Some(self.floats::<2>(&uvs, Dimensions::Vec2)?),
            _ => None,
        };
        let indices = match primitive.indices() {
            Some(accessor) => self.indices(&accessor)?,
            None => (0..positions.len() as u32).collect(),
        };
        if let Some(&index) = indices.iter().find(|&&i| i as usize >= positions.len()) {
            let (index, count) = (u64::from(index), positions.len());
            return Err(MeshError::Index {
                what: "triangle",
                element: self.surface.triangles.len(),
                index,
                count,
            });
        }
        match (&mut self.uvs, uvs.filter(|uvs| uvs.len() == positions.len())) {
            (Some(all), Some(uvs)) => all.extend(uvs),
            _ => self.uvs = None,
        }
        let first = self.surface.positions.len() as u32;
        let mirrors = place.fixed_view::<3, 3>(0, 0).determinant() < 0.0;
        self.surface.positions.extend(positions.iter().map(|p| {
            let p = Point3::from(p.map(f64::from));
            <[f64; 3]>::from(place.transform_point(&p).coords)
        }));
        self.surface.triangles.extend(indices.as_chunks::<3>().0.iter().map(|t| {
            let [a, b, c] = t.map(|v| v + first);
            if mirrors { [a, c, b] } else { [a, b, c] }
        }));
        Ok(())
    }

    fn floats<const N: usize>(
        &self,
        accessor: &Accessor<'_>,
        dimensions: Dimensions,
    ) -> Result<Vec<[f32; N]>, MeshError> {
        if accessor.data_type() != DataType::F32 || accessor.dimensions() != dimensions {
            let found = format!("{:?} of {:?}", accessor.dimensions(), accessor.data_type());
            return Err(wrong(format!("{dimensions:?} of F32"), found));
        }
        let items = self.items(accessor, 4 * N)?;
        let items = items.map(|item| {
            std::array::from_fn(|i| item[4 * i..].first_chunk().map_or(f32::NAN, |b| f32::from_le_bytes(*b)))
        });
        Ok(items.collect())
    }

    fn indices(&self, accessor: &Accessor<'_>) -> Result<Vec<u32>, MeshError> {
        let size = match (accessor.data_type(), accessor.dimensions()) {
            (DataType::U8, Dimensions::Scalar) => 1,
            (DataType::U16, Dimensions::Scalar) => 2,
            (DataType::U32, Dimensions::Scalar) => 4,
            other => return Err(wrong("indices of U8, U16 or U32", format!("{other:?}"))),
        };
        let items = self.items(accessor, size)?;
        Ok(items.map(|item| item.iter().rev().fold(0, |n, &byte| n << 8 | u32::from(byte))).collect())
    }

    /// The bytes of each item of an accessor. All its numbers come from the file, so none is trusted.
    fn items(&self, accessor: &Accessor<'_>, size: usize) -> Result<impl Iterator<Item = &[u8]>, MeshError> {
        let Some(view) = accessor.view().filter(|_| accessor.sparse().is_none()) else {
            return Err(wrong("data that is stored whole", "a sparse accessor"));
        };
        let stride = view.stride().unwrap_or(size).max(1);
        let count = accessor.count();
        let range = || {
            let view_end = view.offset().checked_add(view.length())?;
            let start = view.offset().checked_add(accessor.offset())?;
            let length = stride.checked_mul(count.checked_sub(1)?)?.checked_add(size)?;
            let end = start.checked_add(length).filter(|end| *end <= view_end)?;
            self.buffers.get(view.buffer().index())?.get(start..end)
        };
        let data = range().ok_or_else(|| {
            wrong(
                "data within its buffer",
                format!("{count} items of {size} bytes from byte {} of {}", accessor.offset(), view.length()),
            )
        })?;
        Ok(data.chunks(stride).map(move |item| &item[..size.min(item.len())]))
    }
}

fn buffers(gltf: &Gltf, folder: &Path) -> Result<Vec<Vec<u8>>, MeshError> {
    let read = |buffer: ::gltf::Buffer<'_>| match buffer.source() {
        Source::Bin => gltf.blob.clone().ok_or_else(|| wrong("binary data after the document", "none")),
        Source::Uri(uri) => match uri.strip_prefix("data:") {
            Some(data) => {
                let text = data.split_once(";base64,").map(|parts| parts.1);
                text.and_then(base64).ok_or_else(|| wrong("data in base 64", "something else"))
            }
            None => {
                // A file beside the document, and nowhere else.
                let path = Path::new(uri);
                if path.components().all(|part| matches!(part, Component::Normal(_))) {
                    super::bytes(&folder.join(path))
                } else {
                    Err(wrong("a file in the folder of the document", uri))
                }
            }
        },
    };
    gltf.buffers().map(read).collect()
}

/// Decodes base 64 (RFC 4648).
fn base64(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    let (mut bits, mut count) = (0_u32, 0);
    for digit in text.trim_end_matches('=').bytes() {
        let value = match digit {
            b'A'..=b'Z' => digit - b'A',
            b'a'..=b'z' => digit - b'a' + 26,
            b'0'..=b'9' => digit - b'0' + 52,
            b'+' => 62,
            b'/' => 63,
            _ => return None,
        };
        bits = bits << 6 | u32::from(value);
        count += 6;
        if count >= 8 {
            count -= 8;
            bytes.push((bits >> count) as u8);
        }
    }
    Some(bytes)
}

fn wrong(expected: impl Into<String>, found: impl Into<String>) -> MeshError {
    parse_error("glTF", Place::Byte(0), expected, found)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A triangle of 36 bytes of positions and 6 bytes of indices, in a node that moves it by 5 and mirrors it.
    pub(in super::super) fn document(uri: &str, count: &str, children: &str) -> String {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
            "nodes":[{{"translation":[5,0,0]{children}}},{{"scale":[-1,1,1],"mesh":0}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],
            "accessors":[
                {{"bufferView":0,"componentType":5126,"count":{count},"type":"VEC3","min":[0,0,0],"max":[1,1,0]}},
                {{"bufferView":1,"componentType":5123,"count":3,"type":"SCALAR"}}],
            "bufferViews":[{{"buffer":0,"byteLength":36}},{{"buffer":0,"byteOffset":36,"byteLength":6}}],
            "buffers":[{{"byteLength":42,"uri":"{uri}"}}]}}"#
        )
    }

    /// Positions (0,0,0), (1,0,0), (0,1,0) and indices 0, 1, 2.
    pub(in super::super) const DATA: &str =
        "data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAAAAABAAIA";
    pub(in super::super) const CHILDREN: &str = r#","children":[1]"#;

    #[test]
    fn nodes_place_their_meshes_and_mirrors_keep_the_outside_outside() {
        let surface = parse(document(DATA, "3", CHILDREN).as_bytes(), Path::new(".")).unwrap();
        assert_eq!(surface.positions, [[5.0, 0.0, 0.0], [4.0, 0.0, 0.0], [5.0, 1.0, 0.0]]);
        assert_eq!(surface.triangles, [[0, 2, 1]]);
    }

    #[test]
    fn what_reaches_beyond_its_data_or_its_folder_is_refused() {
        let message = |text: String| parse(text.as_bytes(), Path::new(".")).unwrap_err().to_string();
        assert!(message(document(DATA, "4", CHILDREN)).contains("data within its buffer"));
        assert!(message(document(DATA, "0", CHILDREN)).contains("data within its buffer"));
        assert!(message(document(DATA, "18446744073709551615", CHILDREN)).contains("data within its buffer"));
        assert!(message(document("../secret.bin", "3", CHILDREN)).contains("in the folder of the document"));
        assert!(message(document("/etc/hostname", "3", CHILDREN)).contains("in the folder of the document"));
        assert!(message(document("data:;base64,!!", "3", CHILDREN)).contains("base 64"));
        assert!(message(document(DATA, "3", r#","children":[0]"#)).contains("a tree of nodes"));
        assert!(message("{}".into()).contains("a glTF 2.0 document"));
        assert!(message("glTF".into()).contains("a glTF 2.0 document"));
    }
}
