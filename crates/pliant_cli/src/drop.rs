//! The command `pliant drop`.

use std::{path::PathBuf, sync::Arc};

use clap::Args;
use pliant_lab::drop::{Drop, DropTick, Dropped, Onto, drop};
use pliant_modal::{Elasticity, ModalModel};

use crate::arguments::elasticity;
use crate::{CliError, output};

/// Largest number of rows of the text.
const ROWS: usize = 20;

#[derive(Args, Debug)]
pub(crate) struct DropArgs {
    /// The model, a body without anchors
    #[arg(value_name = "MODEL.modal")]
    model: PathBuf,
    /// Gap under the lowest point of the body, m
    #[arg(long, value_name = "H", default_value_t = 0.1, allow_negative_numbers = true)]
    height: f64,
    /// Tilt of the ground about the z axis, degrees. The body is laid on it as it stood on the
    /// level
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_negative_numbers = true)]
    tilt: f64,
    /// Coefficient of friction
    #[arg(long, value_name = "MU", default_value_t = 0.5, allow_negative_numbers = true)]
    friction: f64,
    /// Gravity along -y, m/s^2
    #[arg(long, value_name = "G", default_value_t = 9.81, allow_negative_numbers = true)]
    gravity: f64,
    /// Duration, s
    #[arg(long, value_name = "S", default_value_t = 2.0, allow_negative_numbers = true)]
    seconds: f64,
    /// Steps per second
    #[arg(long, value_name = "HZ", default_value_t = 60.0, allow_negative_numbers = true)]
    rate: f64,
    /// What the body falls onto: `plane`, `sphere:R`, a ball of radius R (m) under its center, or a
    /// model, a body that stands under it on a plane. A body with anchors keeps them
    #[arg(long, value_name = "plane|sphere:R|MODEL.modal", value_parser = onto, default_value = "plane")]
    onto: Under,
    /// Elasticity of the bodies: linear or reduced [default: reduced if the model has a material]
    #[arg(long, value_parser = elasticity)]
    elasticity: Option<Elasticity>,
    /// Prints one line of JSON with every step
    #[arg(long)]
    json: bool,
}

/// What the body falls onto, as it is written.
#[derive(Debug, Clone)]
enum Under {
    Plane,
    Sphere(f64),
    Model(PathBuf),
}

fn onto(text: &str) -> Result<Under, String> {
    let expected = || "expected plane, sphere:R with R in m, or the file of a model".to_owned();
    match text.strip_prefix("sphere:") {
        Some(radius) => radius.trim().parse().map(Under::Sphere).map_err(|_| expected()),
        None if text == "plane" => Ok(Under::Plane),
        None if text.ends_with(".modal") => Ok(Under::Model(text.into())),
        None => Err(expected()),
    }
}

pub(crate) fn run(args: &DropArgs) -> Result<(), CliError> {
    let model = Arc::new(ModalModel::read(&args.model)?);
    let onto = match &args.onto {
        Under::Plane => Onto::Plane,
        Under::Sphere(radius) => Onto::Sphere(*radius),
        Under::Model(path) => Onto::Body(Arc::new(ModalModel::read(path)?)),
    };
    let asked = Drop {
        height: args.height,
        tilt: args.tilt,
        friction: args.friction,
        gravity: args.gravity,
        seconds: args.seconds,
        rate: args.rate,
        onto,
        elasticity: args.elasticity,
    };
    let dropped = drop(&model, &asked)?;
    if args.json { output::print_json(&dropped) } else { output::print(&text(&dropped)) }
}

fn text(dropped: &Dropped) -> String {
    let total = |tick: &DropTick| tick.kinetic + tick.elastic + tick.potential;
    let ticks = &dropped.ticks;
    let mut out = "    time    center x, y, z (m)                force x, y, z (N)              contacts  \
                   penetration (m)  energy (J)\n"
        .to_owned();
    let every = ticks.len().div_ceil(ROWS).max(1);
    // The last tick is always shown.
    for tick in ticks.iter().rev().step_by(every).collect::<Vec<_>>().into_iter().rev() {
        let ([x, y, z], [fx, fy, fz]) = (tick.center, tick.contact_force);
        out += &format!(
            "{:8.4}  {x:10.6} {y:10.6} {z:10.6}  {fx:10.4} {fy:10.4} {fz:10.4}  {:8}  {:15.3e}  {:10.6}\n",
            tick.time,
            tick.contacts,
            tick.penetration,
            total(tick),
        );
    }
    let start = ticks.first().map_or(0.0, total);
    let gain = ticks.iter().map(|tick| total(tick) - start).fold(0.0, f64::max);
    let t = &dropped.step_us;
    out + &format!(
        "mass             {:.6} kg\n\
         contact sites    {}\n\
         energy           never more than {gain:.3e} J above the start\n\
         elasticity       {}\n\
         step             {:.2} us (99 %: {:.2}, 99.9 %: {:.2})",
        dropped.mass, dropped.sites, dropped.elasticity, t.p50, t.p99, t.p999
    )
}
