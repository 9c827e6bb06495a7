//! glTF 2.0, `.gltf` and `.glb`: the triangles of the default scene (else of all scenes), placed by their nodes.
//!
//! The document is read here and not by the `gltf` crate, whose validation panics on some damaged documents.

use std::{
    collections::HashMap,
    path::{Component, Path},
};

use nalgebra::{Matrix4, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, de::IgnoredAny};

use super::cursor::parse_error;
use crate::{MeshError, Place, Surface};

/// Deeper trees of nodes are refused: they may be rings.
const DEEPEST: usize = 200;
/// More placed nodes than this are refused: nodes may share children, and their number grow without bound.
const MAX_NODES: usize = 100_000;

const TRIANGLES: u32 = 4;
const UNSIGNED_BYTE: u32 = 5121;
const UNSIGNED_SHORT: u32 = 5123;
const UNSIGNED_INT: u32 = 5125;
const FLOAT: u32 = 5126;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Document {
    asset: Asset,
    #[serde(default)]
    extensions_required: Vec<String>,
    scene: Option<usize>,
    #[serde(default)]
    scenes: Vec<Scene>,
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    meshes: Vec<Mesh>,
    #[serde(default)]
    accessors: Vec<Accessor>,
    #[serde(default)]
    buffer_views: Vec<View>,
    #[serde(default)]
    buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
struct Asset {
    version: String,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct Node {
    #[serde(default)]
    children: Vec<usize>,
    mesh: Option<usize>,
    /// By columns; in its place may stand the next three.
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    /// A unit quaternion x, y, z, w.
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    attributes: HashMap<String, usize>,
    indices: Option<usize>,
    mode: Option<u32>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    count: usize,
    #[serde(rename = "type")]
    kind: String,
    sparse: Option<IgnoredAny>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<String>,
}

/// `folder` is where files that the glTF names are looked for.
pub(super) fn parse(bytes: &[u8], folder: &Path) -> Result<Surface, MeshError> {
    let (json, blob) = chunks(bytes)?;
    let document: Document = serde_json::from_slice(json)
        .map_err(|e| parse_error("glTF", Place::Line(e.line()), "a glTF 2.0 document", e.to_string()))?;
    if !document.asset.version.starts_with("2.") {
        return Err(wrong("version 2", document.asset.version));
    }
    if let Some(extension) = document.extensions_required.first() {
        return Err(wrong("a document that needs no extension", extension.as_str()));
    }
    let buffers = document.buffers.iter().map(|b| b.read(blob, folder)).collect::<Result<_, _>>()?;
    let mut reader =
        Reader { document: &document, buffers, surface: Surface::default(), uvs: Some(Vec::new()), nodes: 0 };
    let scenes = match document.scene {
        Some(scene) => std::slice::from_ref(item(&document.scenes, scene, "scene")?),
        None => &document.scenes,
    };
    for &node in scenes.iter().flat_map(|scene| &scene.nodes) {
        reader.node(node, Matrix4::identity(), 0)?;
    }
    reader.surface.uvs = reader.uvs.filter(|uvs| !uvs.is_empty());
    Ok(reader.surface)
}

/// The document, and the binary data that may follow it in a `.glb`.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), MeshError> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    // Magic, version, length; then chunks of length, type, data.
    let mut rest = bytes.get(12..).unwrap_or_default();
    let (mut json, mut blob) = (None, None);
    while let Some((head, data)) = rest.split_first_chunk::<8>() {
        let [a, b, c, d, kind @ ..] = *head;
        let length = u32::from_le_bytes([a, b, c, d]) as usize;
        let (data, next) = data.split_at_checked(length).ok_or_else(|| {
            wrong(
                format!("a chunk of {length} bytes"),
                format!("{} bytes to the end of the file", data.len()),
            )
        })?;
        match &kind {
            b"JSON" => json = Some(data),
            b"BIN\0" => blob = Some(data),
            _ => {}
        }
        rest = next;
    }
    let json = json.ok_or_else(|| wrong("a JSON chunk", "the end of the file"))?;
    Ok((json, blob))
}

struct Reader<'a> {
    document: &'a Document,
    buffers: Vec<Vec<u8>>,
    surface: Surface,
    /// Given up when a mesh has none.
    uvs: Option<Vec<[f32; 2]>>,
    nodes: usize,
}

impl Reader<'_> {
    fn node(&mut self, node: usize, parent: Matrix4<f64>, depth: usize) -> Result<(), MeshError> {
        self.nodes += 1;
        if depth > DEEPEST || self.nodes > MAX_NODES {
            return Err(wrong("a tree of nodes", "nodes that are their own children, or very many"));
        }
        let document = self.document;
        let node = item(&document.nodes, node, "node")?;
        let place = parent * node.place();
        if let Some(mesh) = node.mesh {
            for primitive in &item(&document.meshes, mesh, "mesh")?.primitives {
                match primitive.mode.unwrap_or(TRIANGLES) {
                    TRIANGLES => self.triangles(primitive, place)?,
                    // Points and lines.
                    0..TRIANGLES => {}
                    other => return Err(wrong("lists of triangles, mode 4", format!("mode {other}"))),
                }
            }
        }
        node.children.iter().try_for_each(|&child| self.node(child, place, depth + 1))
    }

    fn triangles(&mut self, primitive: &Primitive, place: Matrix4<f64>) -> Result<(), MeshError> {
        let Some(&positions) = primitive.attributes.get("POSITION") else {
            return Err(wrong("a mesh with positions", "one without"));
        };
        let positions: Vec<[f32; 3]> = self.floats(positions, "VEC3")?;
        let uvs: Option<Vec<[f32; 2]>> =
            primitive.attributes.get("TEXCOORD_0").and_then(|&uvs| self.floats(uvs, "VEC2").ok());
        let indices = match primitive.indices {
            Some(indices) => self.indices(indices)?,
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
        let first = u32::try_from(self.surface.positions.len() + positions.len())
            .map_err(|_| wrong("at most 4 billion vertices", "more"))?
            - positions.len() as u32;
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

    fn floats<const N: usize>(&self, accessor: usize, kind: &str) -> Result<Vec<[f32; N]>, MeshError> {
        let accessor = item(&self.document.accessors, accessor, "accessor")?;
        if accessor.component_type != FLOAT || accessor.kind != kind {
            let found = format!("{} of type {}", accessor.kind, accessor.component_type);
            return Err(wrong(format!("{kind} of type {FLOAT}"), found));
        }
        let numbers = |item: &[u8]| {
            let mut numbers = item.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
            std::array::from_fn(|_| numbers.next().unwrap_or(f32::NAN))
        };
        Ok(self.items(accessor, 4 * N)?.map(numbers).collect())
    }

    fn indices(&self, accessor: usize) -> Result<Vec<u32>, MeshError> {
        let accessor = item(&self.document.accessors, accessor, "accessor")?;
        let size = match (accessor.component_type, accessor.kind.as_str()) {
            (UNSIGNED_BYTE, "SCALAR") => 1,
            (UNSIGNED_SHORT, "SCALAR") => 2,
            (UNSIGNED_INT, "SCALAR") => 4,
            (component, kind) => {
                return Err(wrong(
                    "SCALAR of type 5121, 5123 or 5125",
                    format!("{kind} of type {component}"),
                ));
            }
        };
        let number = |item: &[u8]| item.iter().rev().fold(0, |n, &byte| n << 8 | u32::from(byte));
        Ok(self.items(accessor, size)?.map(number).collect())
    }

    /// The bytes of each item of an accessor. All its numbers come from the file, so none is trusted.
    fn items(&self, accessor: &Accessor, size: usize) -> Result<impl Iterator<Item = &[u8]>, MeshError> {
        let Some(view) = accessor.buffer_view.filter(|_| accessor.sparse.is_none()) else {
            return Err(wrong("data that is stored whole", "a sparse accessor"));
        };
        let view = item(&self.document.buffer_views, view, "buffer view")?;
        let buffer = item(&self.buffers, view.buffer, "buffer")?;
        let stride = view.byte_stride.unwrap_or(size).max(size);
        let range = || {
            let data =
                buffer.get(view.byte_offset..)?.get(..view.byte_length)?.get(accessor.byte_offset..)?;
            let length = stride.checked_mul(accessor.count.checked_sub(1)?)?.checked_add(size)?;
            data.get(..length)
        };
        let data = range().ok_or_else(|| {
            let (count, at) = (accessor.count, accessor.byte_offset);
            wrong("data within its buffer", format!("{count} items of {size} bytes from byte {at}"))
        })?;
        Ok(data.chunks(stride).map(move |item| &item[..size.min(item.len())]))
    }
}

impl Node {
    fn place(&self) -> Matrix4<f64> {
        if let Some(matrix) = &self.matrix {
            return Matrix4::from_column_slice(matrix);
        }
        let translation = Translation3::from(self.translation.unwrap_or_default());
        let rotation = self
            .rotation
            .map_or_else(UnitQuaternion::identity, |q| UnitQuaternion::from_quaternion(Quaternion::from(q)));
        let scale = Vector3::from(self.scale.unwrap_or([1.0; 3]));
        translation.to_homogeneous() * rotation.to_homogeneous() * Matrix4::new_nonuniform_scaling(&scale)
    }
}

impl Buffer {
    fn read(&self, blob: Option<&[u8]>, folder: &Path) -> Result<Vec<u8>, MeshError> {
        let Some(uri) = &self.uri else {
            return blob.map(<[u8]>::to_vec).ok_or_else(|| wrong("binary data after the document", "none"));
        };
        if let Some(data) = uri.strip_prefix("data:") {
            let text = data.split_once(";base64,").map(|parts| parts.1);
            return text.and_then(base64).ok_or_else(|| wrong("data in base 64", "something else"));
        }
        // A file beside the document, and nowhere else.
        let path = Path::new(uri);
        if path.components().all(|part| matches!(part, Component::Normal(_))) {
            super::bytes(&folder.join(path))
        } else {
            Err(wrong("a file in the folder of the document", uri.as_str()))
        }
    }
}

fn item<'a, T>(items: &'a [T], index: usize, what: &str) -> Result<&'a T, MeshError> {
    items
        .get(index)
        .ok_or_else(|| wrong(format!("one of {} {what}s", items.len()), format!("{what} {index}")))
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
        assert!(message(document(DATA, "3", r#","children":[9]"#)).contains("one of 2 nodes, found node 9"));
        assert!(message("{}".into()).contains("a glTF 2.0 document"));
        assert!(message("glTF".into()).contains("a JSON chunk"));
    }

    #[test]
    fn a_glb_holds_its_own_data() {
        let text = document("", "3", CHILDREN).replace(r#","uri":"""#, "");
        let data = base64(DATA.split_once(',').unwrap().1).unwrap();
        let mut glb = b"glTF\x02\0\0\0\0\0\0\0".to_vec();
        for (kind, chunk) in [(b"JSON", text.as_bytes()), (b"BIN\0", &data)] {
            glb.extend((chunk.len() as u32).to_le_bytes());
            glb.extend(kind);
            glb.extend(chunk);
        }
        assert_eq!(parse(&glb, Path::new(".")).unwrap().triangles, [[0, 2, 1]]);
        assert!(parse(&glb[..glb.len() - 1], Path::new(".")).is_err());
    }
}
