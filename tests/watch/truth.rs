//! Prints the shapes of a host's trace (`dedicated_server --trace`) at some ticks as JSON: the
//! model's size, and for each tick that is there the positions of all vertices, m, body axes.
//! `tests/watch/run.sh` compares what a browser shows with them.
//!
//! ```sh
//! watch_truth TRACE BODY.modal TICK...
//! ```
#![allow(missing_docs, reason = "a program for a test")]

#[path = "../../examples/session/mod.rs"]
mod session;

use std::error::Error;
use std::path::Path;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(trace), Some(body)) = (arguments.next(), arguments.next()) else {
        return Err("expected TRACE BODY.modal TICK...".into());
    };
    let model = session::model(Path::new(&body))?;
    let truth = session::trace::truth(Path::new(&trace))?;
    let mut shapes = Vec::new();
    for tick in arguments {
        let Some(q) = truth.get(&tick.parse::<u64>()?) else { continue };
        let mut q = q.clone();
        q.resize(model.mode_count(), 0.0);
        let mut out = vec![[0.0f32; 3]; model.surface().positions().len()];
        // As the host draws it: warped where the elasticity is linear.
        model.basis().reconstruct(&q, true, &mut out);
        shapes.push(format!("\"{tick}\":{:?}", out.as_flattened()));
    }
    println!("{{\"size\":{},\"ticks\":{{{}}}}}", model.size(), shapes.join(","));
    Ok(())
}
