//! The command `pliant bake`.

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use pliant_bake::{Anchor, BakeCache, BakeConfig, Region, Stage, bake_cached};
use pliant_lab::{
    Progress,
    fill::{Filled, fill},
};
use pliant_mesh::{Repair, io};
use pliant_modal::{Damping, Element, ModalModel};
use serde::Serialize;

use crate::CliError;
use crate::output::{self, Summary};
use crate::progress::Bar;

const MAX_THREADS: usize = 1024;

#[derive(Args, Debug)]
pub(crate) struct BakeArgs {
    /// A surface, repaired if needed (.obj, .stl, .ply, .gltf, .glb), a scene (.ron) or tetrahedra
    /// (.msh, .vtk, .mesh, .veg). Of a glTF file the painted _STIFFNESS, _DENSITY and _ANCHOR count
    input: PathBuf,
    /// Approximate number of tetrahedra for a surface or a scene [default: 10000]
    #[arg(long, allow_negative_numbers = true)]
    tets: Option<usize>,
    /// Finite element: tet4 or tet10
    #[arg(long, default_value = "tet10", value_parser = element)]
    element: Element,
    /// Coordinates to keep, or elastic modes of a linear body [default: 36, or 60 if linear]
    #[arg(long, allow_negative_numbers = true)]
    modes: Option<usize>,
    /// Material for large strains: neo-hookean, st-venant-kirchhoff, or linear for none, which has
    /// a smaller file and a cheaper step
    #[arg(long, value_name = "NAME", default_value_t = BakeConfig::default().material_name())]
    material: String,
    /// Young's modulus, 1e-3 to 1e15 Pa
    #[arg(long, value_name = "PA", default_value_t = 1e5, allow_hyphen_values = true)]
    young: f64,
    /// Poisson ratio, -0.99 to 0.49999
    #[arg(long, value_name = "NU", default_value_t = 0.4, allow_hyphen_values = true)]
    poisson: f64,
    /// Density, 1e-6 to 1e7 kg/m^3
    #[arg(long, value_name = "KG_M3", default_value_t = 1000.0, allow_hyphen_values = true)]
    density: f64,
    /// Rayleigh damping: c = A + B omega^2, A in 1/s, B in s
    #[arg(long, value_name = "A,B", value_parser = rayleigh, conflicts_with = "damping_ratio", allow_hyphen_values = true)]
    rayleigh: Option<[f64; 2]>,
    /// Fraction of critical damping in every mode [default: 0.03]
    #[arg(long, value_name = "Z", allow_hyphen_values = true)]
    damping_ratio: Option<f64>,
    /// Fixes the nodes of a half-space, such as 'x<0.01' (m). Repeatable. Without an anchor, given
    /// or painted, the body is free
    #[arg(long = "anchor", value_name = "AXIS<NUMBER", allow_hyphen_values = true)]
    anchors: Vec<Anchor>,
    /// Makes a part of the body stiffer or heavier, such as 'x>0.2 & y<0.1: stiffness 50, density
    /// 1.5' (factors). Repeatable
    #[arg(long = "region", value_name = "HALF-SPACES: FACTORS", allow_hyphen_values = true)]
    regions: Vec<Region>,
    /// A surface to use instead of the tetrahedra's boundary. The surface moves with the tetrahedra
    #[arg(long, value_name = "SURFACE")]
    skin: Option<PathBuf>,
    /// Writes K.mtx and M.mtx (MatrixMarket) into this folder after the bake succeeded
    #[arg(long, value_name = "DIR")]
    export_matrices: Option<PathBuf>,
    /// Folder of finished bakes, so that an unchanged bake is not repeated [default: a folder
    /// `pliant` in the user's cache]
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Bakes even if the result is cached, and caches nothing
    #[arg(long, conflicts_with = "cache")]
    no_cache: bool,
    /// Number of threads [default: one per core]. The result is the same to the bit
    #[arg(long, allow_negative_numbers = true)]
    threads: Option<usize>,
    /// The model to write
    #[arg(short, long, value_name = "X.modal")]
    output: PathBuf,
    /// Prints JSON: the output of `inspect --json`, the repairs and the seconds spent
    #[arg(long)]
    json: bool,
}

fn element(text: &str) -> Result<Element, String> {
    match text {
        "tet4" => Ok(Element::Tet4),
        "tet10" => Ok(Element::Tet10),
        _ => Err("expected tet4 or tet10".to_owned()),
    }
}

fn rayleigh(text: &str) -> Result<[f64; 2], String> {
    let expected = "expected two numbers with a comma between them, A in 1/s and B in s";
    let (a, b) = text.split_once(',').ok_or(expected)?;
    let number = |text: &str| text.trim().parse().map_err(|_| expected.to_owned());
    Ok([number(a)?, number(b)?])
}

#[derive(Serialize)]
struct BakeReport {
    #[serde(flatten)]
    summary: Summary,
    /// True if the bake was read from the cache, so that the times cover reading only.
    cached: bool,
    /// Repairs of a defective surface. Null if none were necessary.
    repair: Option<Mended>,
    seconds: Seconds,
}

#[derive(Serialize)]
struct Mended {
    welded_vertices: usize,
    dropped_triangles: usize,
    turned_triangles: usize,
    covered_holes: usize,
}

impl From<Repair> for Mended {
    fn from(repair: Repair) -> Self {
        Self {
            welded_vertices: repair.welded_vertices,
            dropped_triangles: repair.dropped_triangles,
            turned_triangles: repair.turned_triangles,
            covered_holes: repair.covered_holes,
        }
    }
}

#[derive(Serialize)]
struct Seconds {
    mesh: f64,
    assemble: f64,
    factor: f64,
    modes: f64,
    material: f64,
    surface: f64,
    total: f64,
}

pub(crate) fn run(args: BakeArgs) -> Result<(), CliError> {
    let start = Instant::now();
    if let Some(got) = args.threads {
        let wrong = CliError::Threads { got, most: MAX_THREADS };
        if !(1..=MAX_THREADS).contains(&got)
            || rayon::ThreadPoolBuilder::new().num_threads(got).build_global().is_err()
        {
            return Err(wrong);
        }
    }
    let mut name = args.input.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    name.truncate(name.floor_char_boundary(ModalModel::MAX_TEXT));
    let defaults = BakeConfig::of_material(&args.material)?;
    let damping = match (args.rayleigh, args.damping_ratio) {
        (Some([alpha, beta]), _) => Damping::Rayleigh { alpha, beta },
        (None, Some(zeta)) => Damping::Ratio(zeta),
        (None, None) => defaults.damping,
    };
    let config = BakeConfig {
        name,
        element: args.element,
        modes: args.modes.unwrap_or(defaults.modes),
        young: args.young,
        poisson: args.poisson,
        density: args.density,
        damping,
        anchors: args.anchors,
        regions: args.regions,
        export_matrices: args.export_matrices,
        ..defaults
    };
    // Perform the cheap checks before the long work.
    config.check()?;
    output::check_folder(&args.output)?;

    let mut bar = Bar::new();
    let skin = args.skin.map(io::read_surface).transpose()?;
    let Filled { mesh, repair, paint } = fill(&args.input, args.tets, &mut bar)?;
    let config = BakeConfig { paint, ..config };
    let mesh_seconds = start.elapsed().as_secs_f64();
    let mut progress = |stage, share| {
        let stage = match stage {
            Stage::Assemble => "assemble",
            Stage::Factor => "factor",
            Stage::Modes => "modes",
            Stage::Material => "material",
            Stage::Surface => "surface",
        };
        bar.report(stage, share);
    };
    let cache = match args.cache {
        _ if args.no_cache => None,
        Some(folder) => Some(BakeCache::new(folder)),
        None => BakeCache::of_user(),
    };
    let (baked, cached, not_kept) = match &cache {
        Some(cache) => {
            let made = bake_cached(cache, &mesh, skin.as_ref(), &config, &mut progress)?;
            (made.bake, made.cached, made.not_kept)
        }
        None => (pliant_bake::bake(&mesh, skin.as_ref(), &config, &mut progress)?, false, None),
    };
    baked.model.write(&args.output)?;
    drop(bar);
    if let (Some(error), Some(cache)) = (not_kept, &cache) {
        eprintln!("pliant: the bake is not kept in {}: {error}", cache.folder().display());
    }

    let times = baked.times;
    let seconds = Seconds {
        mesh: mesh_seconds,
        assemble: times.assemble,
        factor: times.factor,
        modes: times.modes,
        material: times.material,
        surface: times.surface,
        total: start.elapsed().as_secs_f64(),
    };
    if args.json {
        let repair = repair.map(Mended::from);
        return output::print_json(&BakeReport {
            summary: Summary::new(&baked.model),
            cached,
            repair,
            seconds,
        });
    }
    output::print(&output::table(&baked.model))?;
    if cached {
        return output::print(&format!("seconds          {:.2}, read from the cache", seconds.total));
    }
    output::print(&format!(
        "seconds          mesh {:.2}, assemble {:.2}, factor {:.2}, modes {:.2}, material {:.2}, \
         surface {:.2}, total {:.2}",
        seconds.mesh,
        seconds.assemble,
        seconds.factor,
        seconds.modes,
        seconds.material,
        seconds.surface,
        seconds.total
    ))
}
