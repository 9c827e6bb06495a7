//! The catalog: which bodies there are, and how they are drawn.

use pliant_modal::ModelHash;

use super::WATCH_VERSION;
use crate::state::{BodyId, Placement};
use crate::wire::{MAX_BODIES, MAX_NAME, Reader, Writer};
use crate::{MAX_MODES, StreamError};

const MAGIC: [u8; 4] = *b"PLWC";
const WARPS: u8 = 1;
const FREE: u8 = 2;
/// Most cameras of a catalog.
const MAX_CAMERAS: usize = 64;

/// A body of a catalog.
#[derive(Debug, Clone, PartialEq)]
pub struct CatalogBody {
    /// Number of the body, which its track has in its name.
    pub id: BodyId,
    /// Name, at most 64 bytes.
    pub name: String,
    /// Its model.
    pub model: ModelHash,
    /// Length of the `.modal` file, bytes; 0 if the host does not publish the file.
    pub file_bytes: u64,
    /// Length of the surface, bytes.
    pub surface_bytes: u64,
    /// Number of coordinates in the body's frames.
    pub modes: u16,
    /// Number of ticks from one frame to the next.
    pub every: u16,
    /// Its shape is drawn with modal warping.
    pub warps: bool,
    /// It has no anchors, so its frames have poses.
    pub free: bool,
    /// Where an anchored body is. Where a body has poses in its frames they say where it is, and
    /// only the scale of its placement counts.
    pub placement: Placement,
    /// Color: red, green, blue and opacity, sRGB, 0 to 255.
    pub color: [u8; 4],
}

impl CatalogBody {
    /// Whether what a watcher has of this body serves for `other`, too. Then only the name, the
    /// placement and the color differ, which it takes over; its frames go on.
    pub fn goes_on_as(&self, other: &Self) -> bool {
        let of_frames = |body: &Self| (body.id, body.model, body.modes, body.every, body.warps, body.free);
        of_frames(self) == of_frames(other)
    }
}

/// A place from which to look.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CatalogCamera {
    /// Position of the eye, m, world.
    pub eye: [f32; 3],
    /// The point that it looks at, m, world.
    pub at: [f32; 3],
    /// Vertical angle of view, rad, above 0 and below pi.
    pub field_of_view: f32,
}

/// What a broadcast contains. A change of it is a new group of its track.
#[derive(Debug, Clone, PartialEq)]
pub struct Catalog {
    /// Number of the broadcast, drawn anew by each start of a host. Ticks of another number are of
    /// another count.
    pub session: u64,
    /// Length of a tick, s.
    pub step: f64,
    /// Name of the session, at most 64 bytes.
    pub name: String,
    /// Bodies, at most as many as a session has.
    pub bodies: Vec<CatalogBody>,
    /// Cameras, at most 64.
    pub cameras: Vec<CatalogCamera>,
}

impl Catalog {
    /// The catalog in bytes. Names are cut to 64 bytes, and bodies and cameras beyond their limits
    /// are left out.
    pub fn encode(&self) -> Vec<u8> {
        let mut w = Writer::with_capacity(64 + 128 * self.bodies.len());
        w.raw(&MAGIC);
        w.u16(WATCH_VERSION);
        w.u64(self.session);
        w.f64(self.step);
        write_name(&mut w, &self.name);
        let bodies = &self.bodies[..self.bodies.len().min(MAX_BODIES)];
        w.u16(bodies.len() as u16);
        for body in bodies {
            w.u16(body.id.0);
            write_name(&mut w, &body.name);
            w.raw(&body.model.0);
            w.u64(body.file_bytes);
            w.u64(body.surface_bytes);
            w.u16(body.modes);
            w.u16(body.every);
            w.u8(if body.warps { WARPS } else { 0 } | if body.free { FREE } else { 0 });
            let place = &body.placement;
            place.position.iter().chain(&place.orientation).for_each(|x| w.f32(*x));
            w.f32(place.scale);
            w.raw(&body.color);
        }
        let cameras = &self.cameras[..self.cameras.len().min(MAX_CAMERAS)];
        w.u16(cameras.len() as u16);
        for camera in cameras {
            camera.eye.iter().chain(&camera.at).for_each(|x| w.f32(*x));
            w.f32(camera.field_of_view);
        }
        w.into_bytes()
    }

    /// Reads a catalog.
    ///
    /// # Errors
    /// An error for wrong bytes, another version, a number out of its range or two bodies of one
    /// number.
    pub fn decode(bytes: &[u8]) -> Result<Self, StreamError> {
        let mut r = Reader::new(bytes);
        check("catalog", r.take("catalog", 4)? == MAGIC, "other bytes", "PLWC")?;
        let version = r.u16("catalog version")?;
        check("catalog version", version == WATCH_VERSION, version, "the version of this library")?;
        let session = r.u64("session")?;
        let step = r.wide("step")?;
        check("step", (1e-6..=10.0).contains(&step), step, "1e-6 to 10 s")?;
        let name = read_name(&mut r)?;
        let count = usize::from(r.u16("bodies")?);
        check("bodies", count <= MAX_BODIES, count, "as many as a session has")?;
        let mut bodies = Vec::new();
        let mut seen = std::collections::BTreeSet::new();
        for _ in 0..count {
            let body = read_body(&mut r)?;
            check("body", seen.insert(body.id), body.id, "a number once")?;
            bodies.push(body);
        }
        let count = usize::from(r.u16("cameras")?);
        check("cameras", count <= MAX_CAMERAS, count, "at most 64")?;
        let mut cameras = Vec::new();
        for _ in 0..count {
            let camera = CatalogCamera {
                eye: vector(&mut r)?,
                at: vector(&mut r)?,
                field_of_view: r.f32("angle of view")? as f32,
            };
            let view = camera.field_of_view;
            check("angle of view", view > 0.0 && view < std::f32::consts::PI, view, "above 0, below pi")?;
            cameras.push(camera);
        }
        r.finish("catalog")?;
        Ok(Self { session, step, name, bodies, cameras })
    }
}

fn read_body(r: &mut Reader<'_>) -> Result<CatalogBody, StreamError> {
    let id = BodyId(r.u16("body")?);
    let name = read_name(r)?;
    let mut model = ModelHash([0; 32]);
    model.0.copy_from_slice(r.take("model", 32)?);
    let (file_bytes, surface_bytes) = (r.u64("bytes of a model")?, r.u64("bytes of a surface")?);
    let modes = r.u16("modes")?;
    check("modes", usize::from(modes) <= MAX_MODES, modes, "at most 4096")?;
    let every = r.u16("ticks of a frame")?;
    check("ticks of a frame", every > 0, every, "1 or more")?;
    let flags = r.u8("flags of a body")?;
    check("flags of a body", flags & !(WARPS | FREE) == 0, flags, "known flags")?;
    let position = vector(r)?;
    let [x, y, z] = vector(r)?;
    let (w, scale) = (r.f32("orientation")? as f32, r.f32("scale")? as f32);
    let placement = Placement { position, orientation: [x, y, z, w], scale };
    check("placement", placement.is_valid(), "other numbers", "a placement")?;
    let mut color = [0; 4];
    color.copy_from_slice(r.take("color", 4)?);
    let (warps, free) = (flags & WARPS != 0, flags & FREE != 0);
    Ok(CatalogBody {
        id,
        name,
        model,
        file_bytes,
        surface_bytes,
        modes,
        every,
        warps,
        free,
        placement,
        color,
    })
}

fn vector(r: &mut Reader<'_>) -> Result<[f32; 3], StreamError> {
    Ok(r.vector("vector")?.map(|x| x as f32))
}

fn write_name(w: &mut Writer, name: &str) {
    let mut end = name.len().min(MAX_NAME);
    while !name.is_char_boundary(end) {
        end -= 1;
    }
    w.u8(end as u8);
    w.raw(&name.as_bytes()[..end]);
}

fn read_name(r: &mut Reader<'_>) -> Result<String, StreamError> {
    let length = usize::from(r.u8("name")?);
    check("name", length <= MAX_NAME, length, "at most 64 bytes")?;
    let name = std::str::from_utf8(r.take("name", length)?);
    check("name", name.is_ok(), "other bytes", "UTF-8")?;
    Ok(name.unwrap_or_default().to_owned())
}

fn check(
    what: &'static str,
    inside: bool,
    found: impl std::fmt::Display,
    expected: &'static str,
) -> Result<(), StreamError> {
    if inside { Ok(()) } else { Err(StreamError::Invalid { what, found: found.to_string(), expected }) }
}
