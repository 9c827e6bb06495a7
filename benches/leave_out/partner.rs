//! The other end of a session, in a program of its own so that its cost is not measured.

use std::{
    error::Error,
    io::{BufRead, BufReader, Read},
    process::{Child, Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use bevy::prelude::*;
use pliant::{
    net::{HostConfig, JoinConfig, NetPlugin, SharedBody},
    prelude::*,
};

use crate::{HZ, scene};

/// The process of the other end. Dropping it closes the input of the process and ends it.
pub struct Partner(Child);

impl Drop for Partner {
    fn drop(&mut self) {
        drop(self.0.stdin.take());
        // The process has no data to save.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(what: &str) -> Result<Child, Box<dyn Error>> {
    let mut command = Command::new(std::env::current_exe()?);
    command.args(["--scene", "host", "--partner", what]);
    Ok(command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?)
}

impl Partner {
    /// Starts a guest in another process and returns the host's plugin for this process.
    pub fn guest() -> Result<(Self, NetPlugin), Box<dyn Error>> {
        let net = NetPlugin::host(HostConfig::default())?;
        let invite = net.invite().ok_or("the host has no invite")?.to_string();
        Ok((Self(start(&invite)?), net))
    }

    /// Starts a host in another process and returns the guest's plugin for this process.
    pub fn host() -> Result<(Self, NetPlugin), Box<dyn Error>> {
        let mut child = start("host")?;
        let mut line = String::new();
        BufReader::new(child.stdout.take().ok_or("no output")?).read_line(&mut line)?;
        let config = JoinConfig { models: vec![scene::model("pip.modal")?], ..default() };
        let net = NetPlugin::join(&line.trim().parse()?, config)?;
        Ok((Self(child), net))
    }
}

/// Runs the other end until its input ends.
pub fn play(part: &str) -> Result<(), Box<dyn Error>> {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin))
        .insert_resource(Time::<Fixed>::from_hz(HZ));
    let pip = scene::model("pip.modal")?;
    if part == "host" {
        let net = NetPlugin::host(HostConfig::default())?;
        println!("{}", net.invite().ok_or("the host has no invite")?);
        app.add_plugins((PliantBodyPlugin::default(), net));
        let body = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(pip));
        app.world_mut().spawn((ModalBody::new(body), SharedBody::named("pip")));
    } else {
        let config = JoinConfig { models: vec![pip], ..default() };
        app.add_plugins((PliantBodyPlugin::default(), NetPlugin::join(&part.parse()?, config)?));
        app.world_mut().spawn((SharedBody::named("pip"), Transform::default()));
    }
    app.finish();
    app.cleanup();
    let over = Arc::new(AtomicBool::new(false));
    let heard = over.clone();
    std::thread::spawn(move || {
        // An error ends the program, too.
        let _ = std::io::stdin().read_to_end(&mut Vec::new());
        heard.store(true, Ordering::Relaxed);
    });
    while !over.load(Ordering::Relaxed) {
        app.update();
        std::thread::sleep(Duration::from_secs_f64(0.9 / HZ));
    }
    Ok(())
}
