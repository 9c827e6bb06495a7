//! A session on four channels of bevy_replicon: messages and datagrams, up to the server and down
//! to its clients.

use std::time::Duration;

use bevy::prelude::*;
use bevy_replicon::{
    prelude::*,
    shared::backend::connected_client::{NetworkId, NetworkIdMap},
};
use pliant::net::transport::{self, Fingerprint, RemotePath};
use pliant::net::{CarrierPort, DisconnectReason, NetSystems, Role};
use serde::{Deserialize, Serialize};

/// The server, as a client's port knows it. A server knows its clients by their network IDs.
pub const SERVER: u64 = 0;

/// Largest datagram, bytes: with the headers of replicon and renet it fits one packet of renet,
/// which cuts longer ones into parts that are all lost with one.
const MAX_DATAGRAM: usize = 1150;

/// The session's bytes from a client to the server, and from the server to a client.
#[derive(Message, Serialize, Deserialize)]
struct Up<const RELIABLE: bool>(Vec<u8>);
#[derive(Message, Serialize, Deserialize)]
struct Down<const RELIABLE: bool>(Vec<u8>);

/// Joins the app's [`CarrierPort`] and replicon. Add it after `RepliconPlugins`.
///
/// The server's tick schedule decides how often it sends, so that it should run in every frame:
/// `ServerPlugin::new(PostUpdate)`.
pub struct RidePlugin {
    /// The app's own name as the others know it: [`name_of`].
    pub key: Fingerprint,
}

/// Returns the key of a client, by its network ID, or of the [`SERVER`].
pub fn name_of(remote: u64) -> Fingerprint {
    Fingerprint::of_name(&remote.to_le_bytes())
}

fn path_to(remote: u64) -> RemotePath {
    RemotePath { key: name_of(remote), role: Role::Hold, max_datagram: MAX_DATAGRAM }
}

impl Plugin for RidePlugin {
    fn build(&self, app: &mut App) {
        app.insert_resource(CarrierPort::new(self.key))
            .add_client_message::<Up<true>>(Channel::Ordered)
            .add_client_message::<Up<false>>(Channel::Unreliable)
            .add_server_message::<Down<true>>(Channel::Ordered)
            .add_server_message::<Down<false>>(Channel::Unreliable)
            // They are about no entity of replicon's, and must not wait for its ticks.
            .make_message_independent::<Down<true>>()
            .make_message_independent::<Down<false>>()
            .add_observer(client_came)
            .add_observer(client_left)
            .add_systems(OnEnter(ClientState::Connected), connected)
            .add_systems(OnExit(ClientState::Connected), disconnected)
            .add_systems(
                PreUpdate,
                (
                    receive_from_server
                        .after(ClientSystems::Receive)
                        .run_if(in_state(ClientState::Connected)),
                    receive_from_clients.after(ServerSystems::Receive).run_if(in_state(ServerState::Running)),
                )
                    .before(NetSystems::Receive),
            )
            .add_systems(
                PostUpdate,
                (
                    send_to_server.before(ClientSystems::Send).run_if(in_state(ClientState::Connected)),
                    send_to_clients.before(ServerSystems::Send).run_if(in_state(ServerState::Running)),
                )
                    .after(NetSystems::Show),
            );
    }
}

// On a client.

fn connected(port: Res<CarrierPort>) {
    port.connected(SERVER, path_to(SERVER));
}

fn disconnected(port: Res<CarrierPort>) {
    port.disconnected(SERVER, DisconnectReason::Lost);
}

fn receive_from_server(
    port: Res<CarrierPort>,
    stats: Res<ClientStats>,
    mut messages: MessageReader<Down<true>>,
    mut datagrams: MessageReader<Down<false>>,
) {
    port.set_round_trip(SERVER, Duration::try_from_secs_f64(stats.rtt).unwrap_or_default());
    for Down(bytes) in messages.read() {
        port.receive(SERVER, transport::Channel::Message, bytes.clone().into());
    }
    for Down(bytes) in datagrams.read() {
        port.receive(SERVER, transport::Channel::Datagram, bytes.clone().into());
    }
}

fn send_to_server(
    port: Res<CarrierPort>,
    mut messages: MessageWriter<Up<true>>,
    mut datagrams: MessageWriter<Up<false>>,
) {
    while let Some(out) = port.poll() {
        match out.channel {
            transport::Channel::Message => _ = messages.write(Up(out.bytes.into())),
            transport::Channel::Datagram => _ = datagrams.write(Up(out.bytes.into())),
        }
    }
}

// On a server.

fn client_came(came: On<Add, AuthorizedClient>, clients: Query<&NetworkId>, port: Res<CarrierPort>) {
    if let Ok(id) = clients.get(came.entity) {
        port.connected(id.get(), path_to(id.get()));
    }
}

fn client_left(left: On<Remove, ConnectedClient>, clients: Query<&NetworkId>, port: Res<CarrierPort>) {
    if let Ok(id) = clients.get(left.entity) {
        port.disconnected(id.get(), DisconnectReason::Lost);
    }
}

fn receive_from_clients(
    port: Res<CarrierPort>,
    clients: Query<(&NetworkId, &ConnectedClientStats)>,
    mut messages: MessageReader<FromClient<Up<true>>>,
    mut datagrams: MessageReader<FromClient<Up<false>>>,
) {
    for (id, stats) in &clients {
        port.set_round_trip(id.get(), Duration::try_from_secs_f64(stats.rtt).unwrap_or_default());
    }
    let id_of = |client: ClientId| Some(clients.get(client.entity()?).ok()?.0.get());
    for up in messages.read() {
        let Some(id) = id_of(up.client_id) else { continue };
        port.receive(id, transport::Channel::Message, up.message.0.clone().into());
    }
    for up in datagrams.read() {
        let Some(id) = id_of(up.client_id) else { continue };
        port.receive(id, transport::Channel::Datagram, up.message.0.clone().into());
    }
}

fn send_to_clients(
    port: Res<CarrierPort>,
    ids: Res<NetworkIdMap>,
    mut messages: MessageWriter<ToClients<Down<true>>>,
    mut datagrams: MessageWriter<ToClients<Down<false>>>,
) {
    while let Some(out) = port.poll() {
        let Some(&client) = ids.get(&NetworkId::new(out.remote)) else { continue };
        let targets = SendTargets::Single(ClientId::Client(client));
        let bytes = out.bytes.into();
        match out.channel {
            transport::Channel::Message => _ = messages.write(ToClients { targets, message: Down(bytes) }),
            transport::Channel::Datagram => _ = datagrams.write(ToClients { targets, message: Down(bytes) }),
        }
    }
}
