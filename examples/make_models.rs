//! Makes the assets of the other examples: the surface and the texture of a jelly, and baked
//! models.
//!
//! What to learn here: how code turns a surface or a description into a model, which settings a
//! bake has, and that the same input gives a bit-identical file.
//!
//! ```sh
//! cargo run --release --example make_models    # remakes everything in assets/ but Pip
//! cargo run --release --example make_models -- /tmp/models
//! ```

use std::{
    error::Error,
    f64::consts::{PI, TAU},
    fmt::Write,
    fs,
    path::{Path, PathBuf},
};

use bevy::{asset::RenderAssetUsages, prelude::*, render::render_resource};
use pliant::{
    bake::{BakeConfig, bake},
    mesh::{StuffOptions, io},
    modal::Damping,
};
use render_resource::{Extent3d, TextureDimension, TextureFormat};

fn main() -> Result<(), Box<dyn Error>> {
    let assets = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets"));
    let folder = std::env::args_os().nth(1).map_or_else(|| assets.to_owned(), PathBuf::from);
    fs::create_dir_all(&folder)?;

    fs::write(folder.join("jelly.obj"), jelly_surface()?)?;
    jelly_texture().try_into_dynamic()?.save(folder.join("jelly.png"))?;

    let held = vec!["y<0.004".parse()?];
    // Small files for examples of crowds and of modes. Of the material of large strains they have
    // none.
    let jelly = BakeConfig {
        modes: 20,
        poisson: 0.45,
        density: 1_000.0,
        damping: Damping::Ratio(0.05),
        anchors: held.clone(),
        sites: Some(64),
        ..BakeConfig::linear()
    };
    let soft = BakeConfig { name: "soft jelly".into(), young: 4e3, ..jelly.clone() };
    let firm = BakeConfig { name: "firm jelly".into(), young: 4e4, ..jelly };
    for (file, config) in [("jelly-soft.modal", soft), ("jelly-firm.modal", firm)] {
        // The tetrahedra fill the surface. The textured surface itself is the skin of the body.
        make(&folder.join("jelly.obj"), 6_000, true, &config, &folder.join(file))?;
    }
    let bud = BakeConfig {
        name: "bud".into(),
        modes: 20,
        young: 4e6,
        density: 300.0,
        damping: Damping::Ratio(0.06),
        anchors: held,
        sites: Some(32),
        ..BakeConfig::linear()
    };
    make(&assets.join("bud.ron"), 2_000, false, &bud, &folder.join("bud.modal"))?;
    let jack = BakeConfig {
        name: "jack".into(),
        modes: 24,
        young: 1.5e5,
        density: 400.0,
        damping: Damping::Ratio(0.04),
        sites: Some(64),
        ..BakeConfig::linear()
    };
    make(&assets.join("jack.ron"), 6_000, false, &jack, &folder.join("jack.modal"))
}

fn make(
    input: &Path,
    tets: usize,
    wears_it: bool,
    config: &BakeConfig,
    output: &Path,
) -> Result<(), Box<dyn Error>> {
    let skin = wears_it.then(|| io::read_surface(input)).transpose()?;
    let (mesh, _) = io::read(input)?.into_tets(&StuffOptions::with_target(tets), &mut |_| ())?;
    let baked = bake(&mesh, skin.as_ref(), config, &mut |_, _| ())?;
    baked.model.write(output)?;
    println!(
        "{}: {} tetrahedra, {} vertices, {} modes from {:.2} Hz, {} KiB, {:.1} s",
        output.display(),
        mesh.tets.len(),
        baked.model.surface().positions().len(),
        baked.model.mode_count(),
        baked.model.omega()[0] / TAU,
        baked.model.file_bytes() / 1024,
        baked.times.total
    );
    Ok(())
}

/// Number of vertices around the jelly, and number of rings from the center of the bottom to the
/// center of the top.
const ROUND: usize = 64;
const RINGS: usize = 22;

/// Returns the surface of a fluted jelly as Wavefront OBJ; u runs around it, v from bottom to top.
fn jelly_surface() -> Result<String, std::fmt::Error> {
    let mut text =
        String::from("# A jelly with texture coordinates; made by the example make_models. Meters, y up.\n");
    for ring in 0..=RINGS {
        let (radius, height, flute) = profile(ring as f64 / RINGS as f64);
        let pole = ring == 0 || ring == RINGS;
        for step in 0..if pole { 1 } else { ROUND } {
            let angle = TAU * step as f64 / ROUND as f64;
            let r = radius * (1.0 + flute * (8.0 * angle).cos());
            writeln!(text, "v {:.6} {:.6} {:.6}", r * angle.cos(), height, r * angle.sin())?;
        }
    }
    for ring in 0..=RINGS {
        for step in 0..=ROUND {
            writeln!(text, "vt {:.5} {:.5}", step as f64 / ROUND as f64, ring as f64 / RINGS as f64)?;
        }
    }
    // Indices of OBJ begin at 1.
    let vertex = |ring: usize, step: usize| match ring {
        0 => 1,
        RINGS => 2 + (RINGS - 1) * ROUND,
        _ => 2 + (ring - 1) * ROUND + step % ROUND,
    };
    let corner = |ring, step| format!("{}/{}", vertex(ring, step), 1 + ring * (ROUND + 1) + step);
    for ring in 0..RINGS {
        // A quadrilateral is two triangles; at a pole one of them remains.
        for step in 0..ROUND {
            let [a, b] = [corner(ring, step), corner(ring, step + 1)];
            let [c, d] = [corner(ring + 1, step), corner(ring + 1, step + 1)];
            if ring > 0 {
                writeln!(text, "f {a} {d} {b}")?;
            }
            if ring + 1 < RINGS {
                writeln!(text, "f {a} {c} {d}")?;
            }
        }
    }
    Ok(text)
}

/// Returns the radius (m), the height (m) and the depth of the flutes at a position on the profile.
///
/// `t` is 0 at the center of the bottom and 1 at the center of the top.
fn profile(t: f64) -> (f64, f64, f64) {
    const FLOOR: f64 = 0.2;
    const TOP: f64 = 0.78;
    const WIDE: f64 = 0.10;
    const NARROW: f64 = 0.062;
    const HIGH: f64 = 0.11;
    if t < FLOOR {
        (WIDE * t / FLOOR, 0.0, 0.07 * t / FLOOR)
    } else if t < TOP {
        let s = (t - FLOOR) / (TOP - FLOOR);
        (WIDE + (NARROW - WIDE) * s, HIGH * s, 0.07 * (1.0 - 0.55 * s))
    } else {
        // The top is a dome with a dimple in the center.
        let s = (t - TOP) / (1.0 - TOP);
        let across = 1.0 - s;
        (NARROW * across, HIGH + 0.016 * (PI * s).sin() - 0.004 * s, 0.0315 * across)
    }
}

/// Returns stripes along the flutes, crossed by rings; the squares stretch with the skin.
fn jelly_texture() -> Image {
    let (width, height) = (256_u32, 128_u32);
    let mut bytes = Vec::with_capacity((4 * width * height) as usize);
    for y in 0..height {
        for x in 0..width {
            let light = (x / 16 + y / 16) % 2 == 0;
            let line = x % 16 == 0 || y % 16 == 0;
            bytes.extend(match (line, light) {
                (true, _) => [255, 236, 214, 255],
                (_, true) => [226, 72, 92, 255],
                (_, false) => [186, 38, 76, 255],
            });
        }
    }
    let size = Extent3d { width, height, depth_or_array_layers: 1 };
    Image::new(size, TextureDimension::D2, bytes, TextureFormat::Rgba8UnormSrgb, RenderAssetUsages::default())
}
