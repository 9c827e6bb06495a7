//! The command `pliant mesh`.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use pliant_lab::fill::fill;
use pliant_mesh::{TetMesh, io, shapes};

use crate::arguments::three;
use crate::progress::Bar;
use crate::{CliError, output};

#[derive(Args, Debug)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub(crate) struct MeshArgs {
    #[command(subcommand)]
    shape: Option<MeshShape>,
    /// A surface, repaired if needed (.obj, .stl, .ply, .gltf, .glb), a scene of rounded parts
    /// (.ron), or tetrahedra to write in another format (.msh, .vtk, .mesh, .veg)
    #[arg(required = true)]
    input: Option<PathBuf>,
    /// Approximate number of tetrahedra for the fill, met within 5 % [default: 10000]
    #[arg(long, allow_negative_numbers = true)]
    tets: Option<usize>,
    /// The file to write: .msh, .vtk, .mesh or .veg
    #[arg(short, long, required = true)]
    output: Option<PathBuf>,
    #[command(flatten)]
    msh: Msh,
}

#[derive(Args, Debug)]
struct Msh {
    /// Version of the Gmsh format for a .msh output: 2.2 or 4.1 [default: 4.1]
    #[arg(long, value_name = "VERSION", value_parser = msh_version)]
    msh_version: Option<io::MshVersion>,
}

#[derive(Subcommand, Debug)]
enum MeshShape {
    /// A bar with one corner at the origin, six tetrahedra per cell
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
        #[command(flatten)]
        msh: Msh,
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
        #[command(flatten)]
        msh: Msh,
    },
    /// A ball around the origin with its boundary nodes on the sphere
    Sphere {
        /// Cells across the diameter
        #[arg(long, allow_negative_numbers = true)]
        cells: usize,
        /// Radius, m
        #[arg(long, allow_hyphen_values = true)]
        radius: f64,
        /// The file to write: .msh, .vtk, .mesh or .veg
        #[arg(short, long)]
        output: PathBuf,
        #[command(flatten)]
        msh: Msh,
    },
}

fn msh_version(text: &str) -> Result<io::MshVersion, String> {
    match text {
        "2.2" => Ok(io::MshVersion::V2_2),
        "4.1" => Ok(io::MshVersion::V4_1),
        _ => Err("expected 2.2 or 4.1".to_owned()),
    }
}

impl Msh {
    /// Performs the cheap checks before the long work.
    fn check(&self, output: &Path) -> Result<(), CliError> {
        output::check_folder(output)?;
        let is_msh = output.extension().is_some_and(|name| name.eq_ignore_ascii_case("msh"));
        if self.msh_version.is_some() && !is_msh {
            return Err(CliError::NoMsh(output.to_path_buf()));
        }
        Ok(())
    }

    fn write(&self, output: &Path, mesh: &TetMesh) -> Result<(), CliError> {
        match self.msh_version {
            Some(version) => io::write_msh_version(output, mesh, version)?,
            None => io::write_tets(output, mesh)?,
        }
        Ok(())
    }
}

pub(crate) fn run(args: MeshArgs) -> Result<(), CliError> {
    let (mesh, path, msh) = match args.shape {
        Some(MeshShape::Bar { cells, size, output, msh }) => {
            msh.check(&output)?;
            (shapes::bar(cells, size)?, output, msh)
        }
        Some(MeshShape::Cube { cells, size, output, msh }) => {
            msh.check(&output)?;
            (shapes::cube(cells, size)?, output, msh)
        }
        Some(MeshShape::Sphere { cells, radius, output, msh }) => {
            msh.check(&output)?;
            (shapes::sphere(cells, radius)?, output, msh)
        }
        None => {
            // Clap requires both arguments if there is no shape.
            let (input, output) = (args.input.unwrap_or_default(), args.output.unwrap_or_default());
            args.msh.check(&output)?;
            (fill(&input, args.tets, &mut Bar::new())?.mesh, output, args.msh)
        }
    };
    msh.write(&path, &mesh)?;
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
