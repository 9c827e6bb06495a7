//! A server and a client of bevy_replicon over renet, with a relay between them that loses packets.

use std::error::Error;
use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use bevy::{prelude::*, state::app::StatesPlugin, transform::TransformPlugin};
use bevy_replicon::prelude::*;
use bevy_replicon_renet::netcode::{
    ClientAuthentication, NetcodeClientTransport, NetcodeServerTransport, ServerAuthentication, ServerConfig,
};
use bevy_replicon_renet::renet::ConnectionConfig;
use bevy_replicon_renet::{RenetChannelsExt, RenetClient, RenetServer, RepliconRenetPlugins};
use pliant::net::NetPlugin;
use pliant::prelude::*;
use pliant::stream::emulator::{EmulatedLink, LinkConfig};

use crate::ride::{RidePlugin, SERVER, name_of};

/// The client's ID.
const CLIENT: u64 = 7;
/// Every game has its own, so that its clients do not meet other servers.
const PROTOCOL: u64 = 1;

/// Two apps of one game, and the network between them.
pub struct Pair {
    pub server: App,
    pub client: App,
    pub relay: Relay,
}

impl Pair {
    /// Starts both apps. They connect while they are updated.
    pub fn new(link: &LinkConfig) -> Result<Self, Box<dyn Error>> {
        let (mut server, mut client) = (app(SERVER), app(CLIENT));
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
        let relay = Relay::start(socket.local_addr()?, link)?;
        serve(&mut server, socket, relay.address)?;
        join(&mut client, relay.address)?;
        Ok(Self { server, client, relay })
    }

    pub fn update(&mut self) {
        self.server.update();
        self.client.update();
    }
}

fn app(id: u64) -> App {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin, StatesPlugin))
        .insert_resource(Time::<Fixed>::from_hz(40.0))
        .add_plugins((RepliconPlugins.set(ServerPlugin::new(PostUpdate)), RepliconRenetPlugins))
        .add_plugins((PliantBodyPlugin::default(), NetPlugin::default(), RidePlugin { key: name_of(id) }));
    app.finish();
    app.cleanup();
    app
}

/// Returns what renet needs to know of replicon's channels.
fn channels(app: &App) -> ConnectionConfig {
    let channels = app.world().resource::<RepliconChannels>();
    ConnectionConfig {
        server_channels_config: channels.server_configs(),
        client_channels_config: channels.client_configs(),
        ..Default::default()
    }
}

fn now() -> Result<Duration, Box<dyn Error>> {
    Ok(SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?)
}

fn serve(app: &mut App, socket: UdpSocket, public: SocketAddr) -> Result<(), Box<dyn Error>> {
    let config = ServerConfig {
        current_time: now()?,
        max_clients: 4,
        protocol_id: PROTOCOL,
        public_addresses: vec![public],
        // An example. A game gives out tokens, which renet checks.
        authentication: ServerAuthentication::Unsecure,
    };
    let server = RenetServer::new(channels(app));
    app.insert_resource(server).insert_resource(NetcodeServerTransport::new(config, socket)?);
    Ok(())
}

fn join(app: &mut App, server_addr: SocketAddr) -> Result<(), Box<dyn Error>> {
    let authentication = ClientAuthentication::Unsecure {
        client_id: CLIENT,
        protocol_id: PROTOCOL,
        server_addr,
        user_data: None,
    };
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
    let client = RenetClient::new(channels(app));
    app.insert_resource(client).insert_resource(NetcodeClientTransport::new(now()?, authentication, socket)?);
    Ok(())
}

/// Carries UDP packets between one client and a server, over an emulated link in each direction.
pub struct Relay {
    pub address: SocketAddr,
    lost: Arc<Mutex<[u64; 2]>>,
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Relay {
    fn start(server: SocketAddr, link: &LinkConfig) -> Result<Self, Box<dyn Error>> {
        let [front, back] = [0, 1].map(|_| UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)));
        let (front, back) = (front?, back?);
        for socket in [&front, &back] {
            socket.set_read_timeout(Some(Duration::from_millis(1)))?;
        }
        let address = front.local_addr()?;
        let (lost, over) = (Arc::<Mutex<[u64; 2]>>::default(), Arc::<AtomicBool>::default());
        let (counts, ends) = (Arc::clone(&lost), Arc::clone(&over));
        let mut links = [1, 2].map(|seed| EmulatedLink::<Vec<u8>>::new(link.clone(), seed));
        let carry = move || {
            let (began, mut client, mut buffer) = (Instant::now(), None, vec![0; 2048]);
            while !ends.load(Ordering::Relaxed) {
                for (socket, link) in [&front, &back].into_iter().zip(&mut links) {
                    loop {
                        match socket.recv_from(&mut buffer) {
                            Ok((len, from)) => {
                                if std::ptr::eq(socket, &front) {
                                    client = Some(from);
                                }
                                link.send(began.elapsed(), buffer[..len].to_vec(), len);
                            }
                            Err(error) if error.kind() == ErrorKind::ConnectionRefused => {}
                            Err(_) => break,
                        }
                    }
                }
                let [up, down] = &mut links;
                while let Some(packet) = up.poll(began.elapsed()) {
                    back.send_to(&packet, server).ok();
                }
                while let Some(packet) = down.poll(began.elapsed()) {
                    client.map(|client| front.send_to(&packet, client));
                }
                let sum = |count: fn(&EmulatedLink<Vec<u8>>) -> u64| links.iter().map(count).sum();
                *counts.lock().unwrap_or_else(PoisonError::into_inner) =
                    [sum(|link| link.counts().lost), sum(|link| link.counts().sent)];
            }
        };
        let thread = std::thread::Builder::new().name("relay".into()).spawn(carry)?;
        Ok(Self { address, lost, over, thread: Some(thread) })
    }

    /// Returns how many packets were lost, and how many were sent, in both directions.
    pub fn lost(&self) -> [u64; 2] {
        *self.lost.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
    }
}
