//! The command line of examples that publish their session for watchers without number.

use bevy::prelude::*;
use clap::Parser;
use pliant::net::NetHost;
use pliant::net::watch::{PublishOptions, RelayOptions, WatchConfig};

/// A relay for watchers, and what they get.
#[derive(Parser, Debug, Clone)]
#[group(skip)]
pub struct Publish {
    /// Publish the session for watchers at this relay, https://HOST:PORT/; a token for the relay
    /// belongs into the address.
    #[arg(long, value_name = "URL")]
    pub publish: Option<String>,

    /// The session's name at the relay.
    #[arg(long, default_value = "pliant")]
    pub session: String,

    /// SHA-256 hash of the relay's certificate, if it is one that the relay made for itself.
    #[arg(long, value_name = "HASH")]
    pub certificate: Option<String>,

    /// Address of the relay in the link for watchers, where it is another one than the host's, or
    /// with a token for watchers. The host's own token is never in the link.
    #[arg(long, value_name = "URL")]
    pub link_relay: Option<String>,

    /// Address of the page for browsers (`pliant watch-page`), for the printed link.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8000/")]
    pub page: String,

    /// Frames a second for watchers.
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    pub watch_rate: f64,

    /// Maximum number of modal coordinates for watchers.
    #[arg(long, value_name = "N", default_value_t = 30)]
    pub watch_modes: usize,
}

impl Publish {
    /// Publishes the session of an app as soon as it is one, and prints the link to the page.
    pub fn add_to(&self, app: &mut App) -> Result<(), String> {
        let Some(relay) = &self.publish else { return Ok(()) };
        let mut relay = RelayOptions::new(relay, &self.session);
        if let Some(hash) = &self.certificate {
            relay = relay.with_certificate(hash).ok_or("--certificate: expected 64 hexadecimal digits")?;
        }
        let options = PublishOptions {
            link_relay: self.link_relay.clone(),
            title: self.session.clone(),
            bodies: WatchConfig { rate: self.watch_rate, modes: self.watch_modes, ..default() },
            ..PublishOptions::new(relay)
        };
        let link = options.link(&self.page);
        app.insert_resource(Wanted(Some((options, link)))).add_systems(Update, publish);
        Ok(())
    }
}

#[derive(Resource)]
struct Wanted(Option<(PublishOptions, String)>);

fn publish(
    mut wanted: ResMut<Wanted>,
    host: Option<ResMut<NetHost>>,
    mut exit: MessageWriter<AppExit>,
    mut reported: Local<u64>,
) {
    let Some(mut host) = host else { return };
    if let Some((options, link)) = wanted.0.take() {
        match host.publish_to_watchers(options) {
            Ok(()) => println!("to watch in a browser: {link}"),
            Err(error) => {
                error!("nothing is published: {error}");
                exit.write(AppExit::error());
            }
        }
    }
    if let Some((_, stats)) = host.published()
        && stats.connections != *reported
    {
        *reported = stats.connections;
        println!("connected to the relay");
    }
}
