//! A model's surface and modes, flattened for a shader.

use pliant_modal::{ModalModel, ModelHash};

use super::MAX_MODEL;
use crate::StreamError;
use crate::codec::quantization::Quanta;
use crate::newmark::Newmark;
use crate::state::MAX_MODES;
use crate::wire::{Reader, Writer};

const MAGIC: [u8; 4] = *b"PLWS";
/// Bytes before the numbers.
const HEAD: usize = 48;
/// Rows are whole numbers of this many parts of the mode's largest entry.
const FULL: f32 = 32_767.0;

/// The value in each of the first `modes` coordinates of one meter of displacement of the surface,
/// kg^1/2. The steps of [`BodyEncoder`](super::BodyEncoder) are these, times the unit. Modes that
/// are hardly visible count as a ten-thousandth of the most visible one.
pub fn coordinate_steps(model: &ModalModel, modes: usize) -> Vec<f32> {
    // Only the places are used, which no integrator changes.
    let quanta = Quanta::new(model, modes, &Newmark { h: 1.0, beta: 0.25, gamma: 0.5 });
    quanta.place.iter().map(|place| *place as f32).collect()
}

/// The surface at rest and the first modes of a model, for a watcher without the kernel.
///
/// A vertex at rest `x` is drawn at `x + D q`, or warped at `x + R~(W q) D q` (Choi and Ko 2005),
/// with the rows `D` of the displacement (kg^-1/2) and `W` of the rotation (kg^-1/2 m^-1). Rows are
/// rounded to 1/32,767 of the mode's largest entry.
#[derive(Debug, Clone, PartialEq)]
pub struct WatchSurface {
    /// Hash of the model.
    pub model: ModelHash,
    /// The value in each coordinate of one meter of displacement, kg^1/2.
    pub places: Vec<f32>,
    /// Rest positions, m, body axes.
    pub positions: Vec<[f32; 3]>,
    /// Triangles, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Factors of each mode for the rows of displacement and rotation.
    pub scales: Vec<[f32; 2]>,
    /// Rows of the displacement in parts of their factor, `[mode][vertex][axis]`.
    pub displacement: Vec<i16>,
    /// Rows of the rotation in parts of their factor, `[mode][vertex][axis]`.
    pub rotation: Vec<i16>,
}

impl WatchSurface {
    /// Flattens the first `modes` modes of a model.
    pub fn new(model: &ModalModel, modes: usize) -> Self {
        let parts = model.parts();
        let modes = modes.min(model.mode_count());
        let rows = 3 * parts.surface.positions().len();
        let largest = |x: &[f32]| x.iter().fold(0.0_f32, |m, x| m.max(x.abs())) / FULL;
        let of = |source: &[f32], mode: usize| -> (f32, Vec<i16>) {
            let row = source.get(mode * rows..(mode + 1) * rows).unwrap_or_default();
            let scale = largest(row);
            let part = |x: &f32| if scale > 0.0 { (x / scale).round() as i16 } else { 0 };
            (scale, row.iter().map(part).collect())
        };
        let mut made = Self {
            model: model.hash(),
            places: coordinate_steps(model, modes),
            positions: parts.surface.positions().to_vec(),
            triangles: parts.surface.triangles().to_vec(),
            scales: Vec::with_capacity(modes),
            displacement: Vec::with_capacity(modes * rows),
            rotation: Vec::with_capacity(modes * rows),
        };
        for mode in 0..modes {
            let (moved, displacement) = of(&parts.displacement, mode);
            let (turned, rotation) = of(&parts.rotation, mode);
            made.scales.push([moved, turned]);
            made.displacement.extend(displacement);
            made.rotation.extend(rotation);
        }
        made
    }

    /// Length in bytes of a surface with the first `modes` modes of a model.
    pub fn encoded_length(model: &ModalModel, modes: usize) -> u64 {
        let surface = model.surface();
        let modes = modes.min(model.mode_count());
        (HEAD + length(surface.positions().len(), surface.triangles().len(), modes)) as u64
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        self.places.len()
    }

    /// The surface in bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut w =
            Writer::with_capacity(HEAD + length(self.positions.len(), self.triangles.len(), self.modes()));
        w.raw(&MAGIC);
        w.u16(super::WATCH_VERSION);
        w.u16(self.modes() as u16);
        w.u32(self.positions.len() as u32);
        w.u32(self.triangles.len() as u32);
        w.raw(&self.model.0);
        self.places.iter().for_each(|x| w.f32(*x));
        self.scales.iter().flatten().for_each(|x| w.f32(*x));
        self.positions.iter().flatten().for_each(|x| w.f32(*x));
        self.triangles.iter().flatten().for_each(|x| w.u32(*x));
        self.displacement.iter().chain(&self.rotation).for_each(|x| w.i16(*x));
        w.into_bytes()
    }

    /// Reads a surface.
    ///
    /// # Errors
    /// An error for bytes of another length than the counts say, for a number that is not finite,
    /// for a triangle with a missing vertex, and for more than [`MAX_MODEL`] bytes.
    pub fn decode(bytes: &[u8]) -> Result<Self, StreamError> {
        let invalid = |what, found: String, expected| Err(StreamError::Invalid { what, found, expected });
        let mut r = Reader::new(bytes);
        if r.take("surface", 4)? != MAGIC {
            return invalid("surface", "other bytes".into(), "PLWS");
        }
        let version = r.u16("surface version")?;
        if version != super::WATCH_VERSION {
            return invalid("surface version", version.to_string(), "the version of this library");
        }
        let modes = usize::from(r.u16("surface modes")?);
        let (vertices, triangles) =
            (r.u32("surface vertices")? as usize, r.u32("surface triangles")? as usize);
        // The counts must be those of the bytes before anything is allocated for them.
        let enough = modes <= MAX_MODES && vertices <= MAX_MODEL && triangles <= MAX_MODEL;
        let model = ModelHash(array(r.take("surface hash", 32)?));
        if !enough || bytes.len() > MAX_MODEL || r.left() != length(vertices, triangles, modes) {
            return invalid("surface length", bytes.len().to_string(), "the length of its counts");
        }
        let floats = |r: &mut Reader<'_>, count: usize| -> Result<Vec<f32>, StreamError> {
            (0..count).map(|_| r.f32("surface number").map(|x| x as f32)).collect()
        };
        let places = floats(&mut r, modes)?;
        if places.iter().any(|x| *x <= 0.0) {
            return invalid("surface places", "a number not above 0".into(), "numbers above 0");
        }
        let pairs = floats(&mut r, 2 * modes)?;
        let points = floats(&mut r, 3 * vertices)?;
        let mut corners = Vec::with_capacity(triangles);
        for _ in 0..triangles {
            let mut corner = [0; 3];
            for index in &mut corner {
                *index = r.u32("surface triangle")?;
                if *index as usize >= vertices {
                    return invalid("surface triangle", index.to_string(), "a vertex of the surface");
                }
            }
            corners.push(corner);
        }
        let rows = |r: &mut Reader<'_>| -> Result<Vec<i16>, StreamError> {
            (0..3 * vertices * modes).map(|_| r.i16("surface rows")).collect()
        };
        Ok(Self {
            model,
            places,
            positions: points.chunks_exact(3).map(array).collect(),
            triangles: corners,
            scales: pairs.chunks_exact(2).map(array).collect(),
            displacement: rows(&mut r)?,
            rotation: rows(&mut r)?,
        })
    }

    /// Position of a vertex at coordinates `q`, m, body axes: what a page computes. `None` for a
    /// vertex that is not on the surface.
    pub fn vertex_position(&self, vertex: usize, q: &[f64], warps: bool) -> Option<[f64; 3]> {
        let rest = self.positions.get(vertex)?;
        let count = self.positions.len();
        let sum = |rows: &[i16], which: usize| -> [f64; 3] {
            std::array::from_fn(|axis| {
                let of = |(k, (q, scale)): (usize, (&f64, &[f32; 2]))| {
                    let row = rows.get((k * count + vertex) * 3 + axis).copied().unwrap_or(0);
                    q * f64::from(row) * f64::from(scale[which])
                };
                q.iter().zip(&self.scales).enumerate().map(of).sum()
            })
        };
        let straight = sum(&self.displacement, 0);
        let moved = if warps { pliant_modal::warp(sum(&self.rotation, 1), straight) } else { straight };
        Some(std::array::from_fn(|axis| f64::from(rest[axis]) + moved[axis]))
    }
}

/// Bytes behind the head of a surface.
fn length(vertices: usize, triangles: usize, modes: usize) -> usize {
    // The counts are limited, so nothing overflows 64 bits.
    12 * modes + 12 * vertices + 12 * triangles + 12 * vertices.saturating_mul(modes)
}

fn array<T: Copy + Default, const N: usize>(from: &[T]) -> [T; N] {
    std::array::from_fn(|k| from.get(k).copied().unwrap_or_default())
}
