//! The command line of every example that hosts, and the invites that it prints.

use std::error::Error;
use std::net::SocketAddr;
use std::path::PathBuf;

use bevy::prelude::*;
use clap::Parser;
use pliant::net::transport::Limits;
use pliant::net::{Access, Grant, Holding, HostConfig, HostOptions, Invite, NetPlugin, Token};
use pliant::stream::emulator::Preset;

/// The address to listen on, and the rights of the users.
#[derive(Parser, Debug, Clone)]
#[group(skip)]
pub struct Serve {
    /// Address to listen on. Use 0.0.0.0:4433 to accept other machines; port 0 is any free port.
    #[arg(long, default_value = "127.0.0.1:4433")]
    pub bind: SocketAddr,

    /// A file with the host's key, created if it does not exist; with it, invites stay valid from
    /// run to run.
    #[arg(long)]
    pub key: Option<PathBuf>,

    /// Accept only users with a token; print one invite to hold and one to watch.
    #[arg(long)]
    pub tokens: bool,

    /// Let only one user at a time hold the body.
    #[arg(long)]
    pub one_at_a_time: bool,

    /// An emulated network under all connections: none, paper-1 to paper-4, lan, wifi and others.
    #[arg(long, default_value = "none", value_parser = super::network)]
    pub network: std::option::Option<Preset>,
}

impl Serve {
    /// Opens the session and prints how to join it.
    pub fn open(&self, name: &str, limits: Limits) -> Result<NetPlugin, Box<dyn Error>> {
        let (hold, watch) = (Token::generate()?, Token::generate()?);
        let access = match self.tokens {
            true => Access::Tokens(vec![Grant::hold(hold), Grant::watch(watch)]),
            false => Access::Anyone,
        };
        let max_guests = limits.peers;
        let net = NetPlugin::host(HostConfig {
            name: name.into(),
            transport: HostOptions {
                bind: self.bind,
                identity: super::identity(self.key.as_deref())?,
                access,
                limits,
                emulation: super::emulation(self.network, 1),
            },
            session: pliant::stream::HostSessionConfig { max_guests, ..default() },
            holding: if self.one_at_a_time { Holding::OneAtATime } else { Holding::Together },
            ..default()
        })?;
        let invite = net.invite().cloned().ok_or("no invite")?;
        println!("to hold:  {invite}");
        if self.tokens {
            println!("to watch: {}", Invite { token: Some(watch), ..invite });
        }
        Ok(net)
    }
}
