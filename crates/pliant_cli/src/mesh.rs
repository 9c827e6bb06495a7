//! `pliant mesh`.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use pliant_mesh::{StuffOptions, TetMesh, io, shapes};

use crate::progress::Bar;
use crate::{CliError, output};

/// Tetrahedra that a surface or a scene is filled with unless told otherwise.
pub(crate) const DEFAULT_TETS: usize = 10_000;

/// Share of a surface's volume that a fill may lose in silence.
const VOLUME_LOSS: f64 = 0.02;

#[derive(Args, Debug)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub(crate) struct MeshArgs {
    #[command(subcommand)]
    shape: Option<Shape>,
    /// A closed surface (.obj, .stl, .ply, .gltf, .glb), a scene of rounded parts (.ron), or tetrahedra to write in
    /// another format (.msh, .vtk, .mesh, .veg)
    #[arg(required = true)]
    input: Option<PathBuf>,
    /// About how many tetrahedra to fill it with, met within 5 % [default: 10000]
    #[arg(long, allow_negative_numbers = true)]
    tets: Option<usize>,
    /// The file to write: .msh, .vtk, .mesh or .veg
    #[arg(short, long, required = true)]
    output: Option<PathBuf>,
}

#[derive(Subcommand, Debug)]
enum Shape {
    /// A bar with one corner at the origin, six tetrahedra to a cell
    Bar {
        /// Cells along x, y and z
        #[arg(long, value_name = "NX,NY,NZ", value_parser = three::<usize>)]
        cells: [usize; 3],
        /// Lengths along x, y and z, m
        #[arg(long, value_name = "LX,LY,LZ", value_parser = three::<f64>, allow_hyphen_values = true)]
        size: [f64; 3],
        /// The file to write: .msh, .vtk, .mesh or .veg
        #[arg(short, long)]
        output: PathBuf,
    },
    /// A cube with one corner at the origin
    Cube {
        /// Cells along an edge
        #[arg(long, allow_negative_numbers = true)]
        cells: usize,
        /// Length of an edge, m
        #[arg(long, allow_hyphen_values = true)]
        size: f64,
        /// The file to write: .msh, .vtk, .mesh or .veg
        #[arg(short, long)]
        output: PathBuf,
    },
    /// A ball around the origin, its boundary nodes on the sphere
    Sphere {
        /// Cells across
        #[arg(long, allow_negative_numbers = true)]
        cells: usize,
        /// Radius, m
        #[arg(long, allow_hyphen_values = true)]
        radius: f64,
        /// The file to write: .msh, .vtk, .mesh or .veg
        #[arg(short, long)]
        output: PathBuf,
    },
}

/// Three numbers with commas between them.
fn three<T: std::str::FromStr>(text: &str) -> Result<[T; 3], String> {
    let parts: Vec<T> = text
        .split(',')
        .map(|part| part.trim().parse().map_err(|_| format!("`{part}` is no such number")))
        .collect::<Result<_, _>>()?;
    parts.try_into().map_err(|parts: Vec<T>| {
        format!("expected three numbers with commas between them, got {}", parts.len())
    })
}

pub(crate) fn run(args: MeshArgs) -> Result<(), CliError> {
    let (mesh, path) = match args.shape {
        Some(Shape::Bar { cells, size, output }) => {
            output::check_folder(&output)?;
            (shapes::bar(cells, size)?, output)
        }
        Some(Shape::Cube { cells, size, output }) => {
            output::check_folder(&output)?;
            (shapes::cube(cells, size)?, output)
        }
        Some(Shape::Sphere { cells, radius, output }) => {
            output::check_folder(&output)?;
            (shapes::sphere(cells, radius)?, output)
        }
        None => {
            // Clap asks for both where there is no shape.
            let (input, output) = (args.input.unwrap_or_default(), args.output.unwrap_or_default());
            output::check_folder(&output)?;
            (fill(&input, args.tets, &mut Bar::new())?, output)
        }
    };
    io::write_tets(&path, &mesh)?;
    let quality = mesh.quality();
    output::print(&format!(
        "{}: {} tetrahedra, {} nodes, {:.6e} m^3, dihedral angles {:.1} to {:.1} degrees",
        path.display(),
        mesh.tets.len(),
        mesh.nodes.len(),
        mesh.volume(),
        quality.min_dihedral_deg,
        quality.max_dihedral_deg,
    ))
}

/// The tetrahedra that a file holds, or that its shape is filled with. `tets` asked for tetrahedra: refused where the
/// file has its own. A fill so coarse that it rounds much of a surface away is told on stderr.
pub(crate) fn fill(input: &Path, tets: Option<usize>, bar: &mut Bar) -> Result<TetMesh, CliError> {
    bar.report("read", 0.0);
    let read = io::read(input)?;
    if tets.is_some() && matches!(read, io::Input::Tets(_)) {
        return Err(CliError::TetsGiven(input.to_path_buf()));
    }
    let options = StuffOptions::with_target(tets.unwrap_or(DEFAULT_TETS));
    let enclosed = if let io::Input::Surface(surface) = &read { surface.volume().abs() } else { 0.0 };
    let mesh = read.into_tets(&options, &mut |share| bar.report("mesh", f64::from(share)))?;
    let filled = mesh.volume();
    if filled < (1.0 - VOLUME_LOSS) * enclosed {
        bar.warn(&format!(
            "the tetrahedra hold {filled:.6e} m^3 of the {enclosed:.6e} m^3 that {} encloses: edges and thin parts are \
             rounded away; more --tets keep more",
            input.display()
        ));
    }
    Ok(mesh)
}
