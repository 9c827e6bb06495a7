//! Reads glTF 2.0, `.gltf` and `.glb`: the triangles of the default scene (otherwise of all
//! scenes), placed by their nodes.
//!
//! This module parses the document itself, because the validation of the `gltf` crate panics on
//! some damaged documents.

use std::{borrow::Cow, collections::HashMap, path::Path};

use nalgebra::{Matrix4, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, de::IgnoredAny};

use super::cursor::parse_error;
use crate::{MeshError, Place, Surface};

/// Largest depth of the node tree. Deeper trees are refused, because they may contain cycles.
const DEEPEST: usize = 200;
/// Largest number of placed nodes and of their primitives. Nodes may share children, so their
/// number could otherwise grow without bound.
const MAX_NODES: usize = 100_000;
/// Number of vertices and of triangles that a document of any size may place.
///
/// Nodes may share a mesh, so a small file may request many vertices. Each byte read allows one
/// more vertex and one more triangle. A stored vertex takes twelve bytes.
const ALWAYS_PLACED: usize = 1_000_000;

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
    scenes: Vec<GltfScene>,
    #[serde(default)]
    nodes: Vec<GltfNode>,
    #[serde(default)]
    meshes: Vec<GltfMesh>,
    #[serde(default)]
    accessors: Vec<Accessor>,
    #[serde(default)]
    buffer_views: Vec<BufferView>,
    #[serde(default)]
    buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
struct Asset {
    version: String,
}

#[derive(Deserialize)]
struct GltfScene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct GltfNode {
    #[serde(default)]
    children: Vec<usize>,
    mesh: Option<usize>,
    /// Transform matrix, column by column. The next three fields may replace it.
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    /// Rotation as a unit quaternion x, y, z, w.
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct GltfMesh {
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
struct BufferView {
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

/// Parses a document. `folder` contains the files that the document names. Also returns the numbers
/// that the vertices have of each of the `attributes`, see [`super::read_painted`].
pub(super) fn parse(
    bytes: &[u8],
    folder: &Path,
    attributes: &[&str],
) -> Result<(Surface, Vec<Vec<f32>>), MeshError> {
    let (json, blob) = chunks(bytes)?;
    let document: Document = serde_json::from_slice(json)
        .map_err(|e| parse_error("glTF", Place::Line(e.line()), "a glTF 2.0 document", e.to_string()))?;
    if !document.asset.version.starts_with("2.") {
        return Err(wrong("version 2", document.asset.version));
    }
    if let Some(extension) = document.extensions_required.first() {
        return Err(wrong("a document that needs no extension", extension.as_str()));
    }
    let mut files = Files { folder, read: HashMap::new(), bytes: 0 };
    document.buffers.iter().try_for_each(|buffer| files.read(buffer))?;
    let buffers = document.buffers.iter().map(|b| b.data(blob, &files)).collect::<Result<_, _>>()?;
    let most = ALWAYS_PLACED.saturating_add(bytes.len()).saturating_add(files.bytes);
    let mut reader = GltfReader {
        document: &document,
        buffers,
        surface: Surface::default(),
        uvs: Some(Vec::new()),
        painted: attributes.iter().map(|&name| (name, Vec::new())).collect(),
        nodes: 0,
        most,
    };
    let scenes = match document.scene {
        Some(scene) => std::slice::from_ref(item(&document.scenes, scene, "scene")?),
        None => &document.scenes,
    };
    for &node in scenes.iter().flat_map(|scene| &scene.nodes) {
        reader.node(node, Matrix4::identity(), 0)?;
    }
    reader.surface.uvs = reader.uvs.filter(|uvs| !uvs.is_empty());
    let count = reader.surface.positions.len();
    let whole = |(_, mut values): (_, Vec<f32>)| {
        if !values.is_empty() {
            values.resize(count, f32::NAN);
        }
        values
    };
    Ok((reader.surface, reader.painted.into_iter().map(whole).collect()))
}

/// Returns the document and the binary data that may follow it in a `.glb`.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), MeshError> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    // A `.glb` starts with magic, version and length. Chunks of length, type and data follow.
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

struct GltfReader<'a> {
    document: &'a Document,
    buffers: Vec<Cow<'a, [u8]>>,
    surface: Surface,
    /// Texture coordinates. They are dropped when one mesh has none.
    uvs: Option<Vec<[f32; 2]>>,
    /// The wanted attributes, and their numbers up to the last vertex that has one.
    painted: Vec<(&'a str, Vec<f32>)>,
    /// Number of nodes and primitives so far.
    nodes: usize,
    /// Largest number of placed vertices, and of placed triangles.
    most: usize,
}

impl GltfReader<'_> {
    fn node(&mut self, node: usize, parent: Matrix4<f64>, depth: usize) -> Result<(), MeshError> {
        self.nodes += 1;
        if depth > DEEPEST || self.nodes > MAX_NODES {
            return Err(wrong("a tree of nodes", "nodes that are their own children, or very many"));
        }
        let document = self.document;
        let node = item(&document.nodes, node, "node")?;
        let place = parent * node.place();
        if let Some(mesh) = node.mesh {
            let primitives = &item(&document.meshes, mesh, "mesh")?.primitives;
            self.nodes = self.nodes.saturating_add(primitives.len());
            for primitive in primitives {
                match primitive.mode.unwrap_or(TRIANGLES) {
                    TRIANGLES => self.triangles(primitive, place)?,
                    // Points and lines are ignored.
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
        let positions = self.floats::<3>(positions, "VEC3")?;
        let vertices = positions.len();
        let indices = primitive.indices.map(|indices| self.indices(indices)).transpose()?;
        let triangles = indices.as_ref().map_or(vertices, |indices| indices.len()) / 3;
        // The check comes before any data is read, because reading takes time and memory too.
        let room = |has: usize, more: usize| has.checked_add(more).is_some_and(|all| all <= self.most);
        if !(room(self.surface.positions.len(), vertices) && room(self.surface.triangles.len(), triangles)) {
            let expected = format!("at most {} placed vertices, and triangles", self.most);
            return Err(wrong(expected, format!("{vertices} and {triangles} more")));
        }
        let uvs = primitive.attributes.get("TEXCOORD_0").and_then(|&uvs| self.floats::<2>(uvs, "VEC2").ok());
        let uvs: Option<Vec<_>> = uvs.filter(|uvs| uvs.len() == vertices).map(Iterator::collect);
        let positions: Vec<[f32; 3]> = positions.collect();
        // What is painted and cannot be read would be missed without a word.
        let scalars = |name: &str| -> Result<Option<Vec<f32>>, MeshError> {
            let Some(&accessor) = primitive.attributes.get(name) else { return Ok(None) };
            let unread = |found: String| wrong(format!("a float of each vertex as {name}"), found);
            let values = self.floats::<1>(accessor, "SCALAR").map_err(|error| unread(error.to_string()))?;
            if values.len() != vertices {
                return Err(unread(format!("{} for {vertices} vertices", values.len())));
            }
            Ok(Some(values.map(|[value]| value).collect()))
        };
        let painted = self.painted.iter().map(|(name, _)| scalars(name)).collect::<Result<Vec<_>, _>>()?;
        let indices: Vec<u32> = indices.map_or_else(|| (0..vertices as u32).collect(), Iterator::collect);
        if let Some(&index) = indices.iter().find(|&&i| i as usize >= positions.len()) {
            let (index, count) = (u64::from(index), positions.len());
            return Err(MeshError::Index {
                what: "triangle",
                element: self.surface.triangles.len(),
                index,
                count,
            });
        }
        match (&mut self.uvs, uvs) {
            (Some(all), Some(uvs)) => all.extend(uvs),
            _ => self.uvs = None,
        }
        let first = u32::try_from(self.surface.positions.len() + positions.len())
            .map_err(|_| wrong("at most 4 billion vertices", "more"))?
            - positions.len() as u32;
        for ((_, all), values) in self.painted.iter_mut().zip(painted) {
            if let Some(values) = values {
                all.resize(first as usize, f32::NAN);
                all.extend(values);
            }
        }
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
        accessor: usize,
        kind: &str,
    ) -> Result<impl ExactSizeIterator<Item = [f32; N]>, MeshError> {
        let accessor = item(&self.document.accessors, accessor, "accessor")?;
        if accessor.component_type != FLOAT || accessor.kind != kind {
            let found = format!("{} of type {}", accessor.kind, accessor.component_type);
            return Err(wrong(format!("{kind} of type {FLOAT}"), found));
        }
        let numbers = |item: &[u8]| {
            let mut numbers = item.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
            std::array::from_fn(|_| numbers.next().unwrap_or(f32::NAN))
        };
        Ok(self.items(accessor, 4 * N)?.map(numbers))
    }

    fn indices(&self, accessor: usize) -> Result<impl ExactSizeIterator<Item = u32>, MeshError> {
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
        Ok(self.items(accessor, size)?.map(number))
    }

    /// Returns the bytes of each item of an accessor. All its numbers come from the file, so none
    /// is trusted.
    fn items(
        &self,
        accessor: &Accessor,
        size: usize,
    ) -> Result<impl ExactSizeIterator<Item = &[u8]>, MeshError> {
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

impl GltfNode {
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

/// Files that a document names, each read once.
struct Files<'a> {
    folder: &'a Path,
    read: HashMap<String, Vec<u8>>,
    /// Total number of bytes of all files.
    bytes: usize,
}

impl Files<'_> {
    fn read(&mut self, buffer: &Buffer) -> Result<(), MeshError> {
        let Some(path) = buffer.file() else { return Ok(()) };
        // Only files in the folder of the document are allowed.
        if !super::is_below(path) {
            return Err(wrong("a file in the folder of the document", path));
        }
        if self.read.contains_key(path) {
            return Ok(());
        }
        let bytes = super::bytes(&self.folder.join(path))?;
        self.bytes = self.bytes.saturating_add(bytes.len());
        if self.bytes as u64 > super::MAX_FILE {
            return Err(wrong(format!("files of at most {} bytes in all", super::MAX_FILE), "more"));
        }
        self.read.insert(path.to_owned(), bytes);
        Ok(())
    }
}

impl Buffer {
    /// Returns the path of the file that the document names for this buffer.
    fn file(&self) -> Option<&str> {
        self.uri.as_deref().filter(|uri| !uri.starts_with("data:"))
    }

    fn data<'a>(&self, blob: Option<&'a [u8]>, files: &'a Files) -> Result<Cow<'a, [u8]>, MeshError> {
        if let Some(path) = self.file() {
            let bytes = files.read.get(path).map(|bytes| Cow::Borrowed(&bytes[..]));
            return bytes.ok_or_else(|| wrong("a file that was read", path));
        }
        let Some(data) = self.uri.as_deref().and_then(|uri| uri.strip_prefix("data:")) else {
            return blob.map(Cow::Borrowed).ok_or_else(|| wrong("binary data after the document", "none"));
        };
        let text = data.split_once(";base64,").map(|parts| parts.1);
        text.and_then(base64).map(Cow::Owned).ok_or_else(|| wrong("data in base 64", "something else"))
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

    fn parse(bytes: &[u8], folder: &Path) -> Result<Surface, MeshError> {
        Ok(super::parse(bytes, folder, &[])?.0)
    }

    /// Makes a document with one triangle: 36 bytes of positions and 6 bytes of indices.
    ///
    /// A node mirrors the triangle, and the first node moves by 5.
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

    /// Two triangles, of which the second has numbers.
    fn painted(attributes: &str, kind: u32) -> String {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}},
                {{"attributes":{{"POSITION":0{attributes}}},"indices":1}}]}}],
            "accessors":[
                {{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}},
                {{"bufferView":1,"componentType":5123,"count":3,"type":"SCALAR"}},
                {{"bufferView":0,"componentType":{kind},"count":3,"type":"SCALAR"}}],
            "bufferViews":[{{"buffer":0,"byteLength":36}},{{"buffer":0,"byteOffset":36,"byteLength":6}}],
            "buffers":[{{"byteLength":42,"uri":"{DATA}"}}]}}"#
        )
    }

    #[test]
    fn numbers_at_vertices_are_read_where_they_are_and_others_have_none() {
        let read = |attributes, kind| {
            let names = ["_STIFFNESS", "_ANCHOR"];
            super::parse(painted(attributes, kind).as_bytes(), Path::new("."), &names).unwrap()
        };
        let (surface, values) = read(r#","_STIFFNESS":2"#, FLOAT);
        assert_eq!((surface.positions.len(), values.len()), (6, 2));
        // The first floats of the data: (0, 0, 0).
        assert!(values[0][..3].iter().all(|x| x.is_nan()) && values[0][3..] == [0.0; 3], "{values:?}");
        assert!(values[1].is_empty());
        let (surface, values) = read("", FLOAT);
        assert_eq!((surface.positions.len(), values), (6, vec![Vec::new(); 2]));
        // Those of another type, and those that are not there, would be missed without a word.
        for (attributes, kind) in [(r#","_STIFFNESS":2"#, UNSIGNED_INT), (r#","_STIFFNESS":9"#, FLOAT)] {
            let text = painted(attributes, kind);
            let error =
                super::parse(text.as_bytes(), Path::new("."), &["_STIFFNESS"]).unwrap_err().to_string();
            assert!(error.contains("_STIFFNESS"), "{error}");
            assert!(parse(text.as_bytes(), Path::new(".")).is_ok(), "nobody has asked for it");
        }
    }

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
        for uri in [
            "nul",
            "COM1.bin",
            "con.txt",
            "a/aux/b.bin",
            "a:stream",
            "C:a.bin",
            "a.bin.",
            "a./b.bin",
            "a /b.bin",
        ] {
            let found = message(document(uri, "3", CHILDREN));
            assert!(found.contains("in the folder of the document"), "{uri}: {found}");
        }
        // In JSON, a backslash is two.
        assert!(message(document("a\\\\b.bin", "3", CHILDREN)).contains("in the folder of the document"));
        assert!(message(document("data:;base64,!!", "3", CHILDREN)).contains("base 64"));
        assert!(message(document(DATA, "3", r#","children":[0]"#)).contains("a tree of nodes"));
        assert!(message(document(DATA, "3", r#","children":[9]"#)).contains("one of 2 nodes, found node 9"));
        assert!(message("{}".into()).contains("a glTF 2.0 document"));
        assert!(message("glTF".into()).contains("a JSON chunk"));
    }

    /// Makes a `.glb` of the document and its data.
    fn glb(text: &str, data: &[u8]) -> Vec<u8> {
        let mut glb = b"glTF\x02\0\0\0\0\0\0\0".to_vec();
        for (kind, chunk) in [(b"JSON", text.as_bytes()), (b"BIN\0", data)] {
            glb.extend((chunk.len() as u32).to_le_bytes());
            glb.extend(kind);
            glb.extend(chunk);
        }
        glb
    }

    #[test]
    fn a_file_takes_no_more_than_its_size_allows() {
        // A tree of ten doublings places a thousand triangles 1,024 times: 3 million corners from
        // 36 kB.
        let nodes: Vec<String> = (1..=10).map(|k| format!(r#"{{"children":[{k},{k}]}}"#)).collect();
        let text = |nodes: &str, buffers: &str| {
            format!(
                r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{nodes}],
                "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":1}}}}]}}],
                "accessors":[{{"bufferView":0,"componentType":5126,"count":3000,"type":"VEC3"}},
                    {{"bufferView":0,"componentType":5126,"count":4500,"type":"VEC2"}}],
                "bufferViews":[{{"buffer":0,"byteLength":36000}}],"buffers":[{buffers}]}}"#
            )
        };
        let data = vec![0; 36_000];
        let shared = format!("{},{}", nodes.join(","), r#"{"mesh":0}"#);
        let error = parse(&glb(&text(&shared, "{}"), &data), Path::new(".")).unwrap_err().to_string();
        assert!(error.contains("placed vertices"), "{error}");
        // 333 meshes of 3,000 vertices are 999,000, which is within the limit. 400 meshes exceed
        // the limit.
        let many = |count: usize| {
            let nodes: Vec<String> = (1..=count).map(|k| k.to_string()).collect();
            let meshes = vec![r#"{"mesh":0}"#; count].join(",");
            text(&format!(r#"{{"children":[{}]}},{meshes}"#, nodes.join(",")), "{}")
        };
        let placed = parse(&glb(&many(333), &data), Path::new(".")).unwrap();
        assert_eq!((placed.positions.len(), placed.triangles.len()), (999_000, 333_000));
        assert!(parse(&glb(&many(400), &data), Path::new(".")).is_err());
        // Every buffer is the same blob. The blob must be borrowed, because copies would take 3.6
        // GB.
        let buffers = vec!["{}"; 100_000].join(",");
        let one = parse(&glb(&text(r#"{"mesh":0}"#, &buffers), &data), Path::new(".")).unwrap();
        assert_eq!(one.triangles.len(), 1_000);
    }

    #[test]
    fn a_file_that_is_named_often_is_read_once() {
        let folder = std::env::temp_dir().join(format!("pliant_gltf_{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("a.bin"), base64(DATA.split_once(',').unwrap().1).unwrap()).unwrap();
        let mut files = Files { folder: &folder, read: HashMap::new(), bytes: 0 };
        for uri in ["a.bin", "a.bin", "a.bin/", "./a.bin"] {
            let read = files.read(&Buffer { uri: Some(uri.into()) });
            assert_eq!(read.is_ok(), uri == "a.bin", "{uri}");
        }
        assert_eq!((files.read.len(), files.bytes), (1, 42));
        let surface = parse(document("a.bin", "3", CHILDREN).as_bytes(), &folder).unwrap();
        assert_eq!(surface.triangles, [[0, 2, 1]]);
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_glb_holds_its_own_data() {
        let text = document("", "3", CHILDREN).replace(r#","uri":"""#, "");
        let data = base64(DATA.split_once(',').unwrap().1).unwrap();
        let glb = glb(&text, &data);
        assert_eq!(parse(&glb, Path::new(".")).unwrap().triangles, [[0, 2, 1]]);
        assert!(parse(&glb[..glb.len() - 1], Path::new(".")).is_err());
    }
}
