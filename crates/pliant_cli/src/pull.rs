//! The command `pliant pull`.

use std::{path::PathBuf, sync::Arc};

use clap::Args;
use pliant_lab::pull::{Pull, Pulled, pull};
use pliant_mesh::{Surface, io};
use pliant_modal::{Elasticity, ModalModel};

use crate::arguments::{elasticity, three};
use crate::{CliError, output};

#[derive(Args, Debug)]
pub(crate) struct PullArgs {
    /// The model, a body with anchors
    #[arg(value_name = "X.modal")]
    model: PathBuf,
    /// Point near the surface where the hand takes hold, m
    #[arg(long, value_name = "X,Y,Z", value_parser = three::<f64>, allow_hyphen_values = true)]
    at: [f64; 3],
    /// Radius of the patch that the hand holds, m
    #[arg(long, allow_negative_numbers = true)]
    radius: f64,
    /// Way of the hand, m
    #[arg(long, value_name = "DX,DY,DZ", value_parser = three::<f64>, allow_hyphen_values = true)]
    by: [f64; 3],
    /// Elasticity of the body: linear or reduced [default: reduced if the model has a material]
    #[arg(long, value_parser = elasticity)]
    elasticity: Option<Elasticity>,
    /// Gravity, m/s^2
    #[arg(long, value_name = "GX,GY,GZ", value_parser = three::<f64>, default_value = "0,0,0", allow_hyphen_values = true)]
    gravity: [f64; 3],
    /// Writes the surface of the pulled body (.ply)
    #[arg(long, value_name = "OUT.ply")]
    surface: Option<PathBuf>,
    /// Prints one line of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &PullArgs) -> Result<(), CliError> {
    if let Some(path) = &args.surface {
        output::check_folder(path)?;
    }
    let model = Arc::new(ModalModel::read(&args.model)?);
    let PullArgs { at, radius, by, elasticity, gravity, .. } = *args;
    let asked = Pull { at, radius, by, elasticity, gravity };
    let pulled = pull(&model, &asked)?;
    if let Some(path) = &args.surface {
        let positions = pulled.surface.iter().map(|p| p.map(f64::from)).collect();
        let triangles = model.surface().triangles().to_vec();
        io::write_surface(path, &Surface { positions, triangles, uvs: None })?;
    }
    if !pulled.at_rest {
        eprintln!("pliant: warning: the body has not come to rest, and the force still changes");
    }
    if args.json { output::print_json(&pulled) } else { output::print(&text(&pulled)) }
}

fn text(pulled: &Pulled) -> String {
    let length = |v: &[f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let list = |v: &[f64; 3]| format!("{:.6}, {:.6}, {:.6}", v[0], v[1], v[2]);
    let (force, way, t) = (length(&pulled.reaction), length(&pulled.moved), &pulled.step_us);
    let stiffness = if way > 0.0 { format!("{:.4} N/m", force / way) } else { "-".to_owned() };
    format!(
        "patch            {} m, {} vertices\n\
         moved            {} m ({way:.6})\n\
         reaction         {} N ({force:.6})\n\
         reaction / way   {stiffness}\n\
         elastic energy   {:.6e} J\n\
         elasticity       {}{}\n\
         step             {:.2} us (99 %: {:.2}, 99.9 %: {:.2})",
        list(&pulled.patch),
        pulled.vertices.len(),
        list(&pulled.moved),
        list(&pulled.reaction),
        pulled.energy,
        pulled.material.map_or_else(
            || pulled.elasticity.to_string(),
            |material| format!("{}, {material}", pulled.elasticity)
        ),
        pulled
            .shapes_ms
            .map_or_else(String::new, |ms| format!(", with shapes of the patch, made in {ms:.0} ms")),
        t.p50,
        t.p99,
        t.p999
    )
}
