//! The Haply Inverse3, through the WebSocket of its service (port 10001). The protocol is JSON with
//! one state for each message sent.
//!
//! On connection, the service sends an inventory of the connected devices. After that, it answers
//! every command with one state. The service's axes are x right, y away from the user, z up, in
//! meters and newtons. Bevy's axes are (x, z, -y). The name of the force field depends on the
//! version of the service: `vector` (from 3.5 on) or `values` (before). The driver tries the name
//! that the inventory suggests first, and the other one if the service refuses the first.
//!
//! Beside its state, every message contains the `status` of the device (documented for services
//! from 3.5 on). A device that is not calibrated gets no force, and its positions are not believed.
//! A device without its power supply, or that is not ready, counts as switched off. Where a service
//! leaves the status out, its last one holds, and without any the device counts as ready.
//!
//! The service has no call that stops a device. The loop's supervisor sends a last command without
//! a force on the same connection, beside whatever the loop's thread waits for, and then closes the
//! connection. What the service does with the force of a connection that is closed, or on which
//! nothing comes any more, is its own matter and is not published.
//!
//! JSON and sockets allocate. Unlike the loop around it, `exchange` therefore allocates.

use std::{
    io::Write,
    net::{Shutdown, TcpStream, ToSocketAddrs},
    sync::Arc,
    time::Duration,
};

use serde_json::{Value, json};
use thiserror::Error;
use tungstenite::{Message, WebSocket, client::client_with_config, protocol::WebSocketConfig};

use crate::{
    Calibration, DeviceInfo, Fault, HapticDevice, Sample, Scheduler, StopHandle, Wrench,
    device::{link::Link, renewal::Renewal},
};

/// Address of the service and choice of the device.
#[derive(Debug, Clone, PartialEq)]
pub struct InverseConfig {
    /// Host and port of the service. Default: `127.0.0.1:10001`.
    pub address: String,
    /// The device's id. With `None` the first device is used. Default: `None`.
    pub device: Option<String>,
    /// Maximum time for an answer, s. Default: 0.1.
    pub timeout: f64,
    /// Rate of the loop, Hz. The device declares a delay of one period, because a force waits that
    /// long for its turn. Default: 1000.
    pub rate: f64,
    /// Name of the force field. With `None` the driver finds it out. Default: `None`.
    pub spelling: Option<Spelling>,
}

impl Default for InverseConfig {
    fn default() -> Self {
        Self { address: "127.0.0.1:10001".into(), device: None, timeout: 0.1, rate: 1000.0, spelling: None }
    }
}

/// Name of the force field in a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Spelling {
    /// `vector`: services from 3.5 on.
    Vector,
    /// `values`: services before 3.5.
    Values,
}

impl Spelling {
    fn field(self) -> &'static str {
        match self {
            Self::Vector => "vector",
            Self::Values => "values",
        }
    }

    fn other(self) -> Self {
        match self {
            Self::Vector => Self::Values,
            Self::Values => Self::Vector,
        }
    }
}

/// Reason why no Inverse could be opened.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum InverseError {
    /// The connection to the service failed.
    #[error("no Inverse service at {address}: {reason}")]
    Connect {
        /// Address of the service.
        address: String,
        /// Reason.
        reason: String,
    },
    /// The connected service does not follow the protocol of an Inverse service.
    #[error("the service at {address} does not speak as an Inverse service does: {reason}")]
    Protocol {
        /// Address of the service.
        address: String,
        /// Reason.
        reason: String,
    },
    /// The service does not have the device.
    #[error("the service at {address} has no Inverse3 {wanted:?}; it has {found:?}")]
    NoDevice {
        /// Address of the service.
        address: String,
        /// The wanted id, if any.
        wanted: Option<String>,
        /// The ids of the connected devices.
        found: Vec<String>,
    },
}

/// An Inverse3, with the grip that may be attached.
pub struct Inverse {
    config: InverseConfig,
    socket: Option<WebSocket<TcpStream>>,
    id: String,
    spelling: Spelling,
    /// Whether the field name is known to be right, because a state has come back for it.
    confirmed: bool,
    last: Sample,
    status: Status,
    sequence: u64,
    switch: Arc<ConnectionSwitch>,
    renewal: Renewal,
    /// Whether the last force was sent too late, so that the next one must be zero.
    late: bool,
}

/// What the service says about the device beside its state.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Status {
    calibrated: bool,
    /// Whether the motors have their power supply.
    powered: bool,
    ready: bool,
}

impl Default for Status {
    /// Returns the status of a device whose service does not tell it.
    fn default() -> Self {
        Self { calibrated: true, powered: true, ready: true }
    }
}

impl Status {
    /// Reads the status in a message. Parts that the service leaves out keep their last values.
    fn read(device: &Value, last: Self) -> Self {
        let flag = |name, last| device["status"][name].as_bool().unwrap_or(last);
        Self {
            calibrated: flag("calibrated", last.calibrated),
            powered: flag("power_supply", last.powered),
            ready: flag("ready", last.ready),
        }
    }

    /// Returns whether the motors exert the force that they are sent.
    fn exerts_force(self) -> bool {
        self.calibrated && self.powered && self.ready
    }
}

/// Ends the connection from another thread, with a command without a force as the last thing it
/// sends.
///
/// A cut acts on the other end of the connection and sends the frame of that command.
struct ConnectionSwitch(Link<Arc<(TcpStream, Vec<u8>)>>);

impl StopHandle for ConnectionSwitch {
    fn cut(&self) {
        if let Some(cut) = self.0.cut() {
            let (stream, zero) = &*cut.device;
            // A service that reads nothing must not hold up the end of the connection.
            let _ = stream.set_nonblocking(true);
            // The loop's thread may be in the middle of a command. The service cannot read either
            // then, and the end of the connection is all that is left.
            let _ = (&*stream).write_all(zero);
            let _ = stream.shutdown(Shutdown::Both);
        }
    }
}

/// Returns the WebSocket frame of a text message from a client (RFC 6455, section 5.2), with a mask
/// of zeros, which leaves the text as it is.
fn text_frame(text: &str) -> Vec<u8> {
    let bytes = text.as_bytes();
    let mut frame = vec![0x81];
    match u16::try_from(bytes.len()) {
        Ok(length @ 0..=125) => frame.push(0x80 | length as u8),
        Ok(length) => {
            frame.push(0x80 | 126);
            frame.extend(length.to_be_bytes());
        }
        Err(_) => {
            frame.push(0x80 | 127);
            frame.extend((bytes.len() as u64).to_be_bytes());
        }
    }
    frame.extend([0; 4]);
    frame.extend(bytes);
    frame
}

impl Inverse {
    /// Returns the ids of the Inverse3 devices that are connected to a service.
    ///
    /// # Errors
    /// Returns an error if there is no service, or if it does not follow the protocol of an Inverse
    /// service.
    pub fn list(config: &InverseConfig) -> Result<Vec<String>, InverseError> {
        let (_, inventory) = connect(config)?;
        Ok(ids(&inventory))
    }

    /// Connects to the service and selects the device.
    ///
    /// # Errors
    /// Returns an error if there is no service, if it does not follow the protocol of an Inverse
    /// service, or if it does not have the device.
    pub fn open(config: InverseConfig) -> Result<Self, InverseError> {
        let (socket, inventory) = connect(&config)?;
        let (id, last, status) = pick(&config, &inventory)?;
        // The session id came with version 3.5, as did the new name of the field.
        let guess = if inventory.get("session_id").is_some() { Spelling::Vector } else { Spelling::Values };
        let spelling = config.spelling.unwrap_or(guess);
        let confirmed = config.spelling.is_some();
        let mut device = Self {
            config,
            socket: None,
            id,
            spelling,
            confirmed,
            last,
            status,
            sequence: 0,
            switch: Arc::new(ConnectionSwitch(Link::new())),
            renewal: Renewal::default(),
            late: false,
        };
        let address = device.config.address.clone();
        let reason = |_| InverseError::Connect { address, reason: "its connection was cut".into() };
        device.take(socket).map_err(reason)?;
        Ok(device)
    }

    /// Takes a new connection, which the supervisor may end. One that was cut while it was being
    /// made is closed, and no force is sent on it.
    fn take(&mut self, socket: WebSocket<TcpStream>) -> Result<(), Fault> {
        self.sequence = 0;
        (self.renewal, self.late) = (Renewal::default(), false);
        let zero = text_frame(&self.command([0.0; 3], false));
        let stream = socket.get_ref().try_clone().map_err(|_| Fault::Gone)?;
        if self.switch.0.open(Arc::new((stream, zero))) {
            self.socket = Some(socket);
            return Ok(());
        }
        self.abandon();
        Err(Fault::Gone)
    }

    /// Forgets a connection on which nothing more can be said.
    fn abandon(&mut self) {
        self.socket = None;
        if let Some(open) = self.switch.0.close() {
            // A second handle would keep the connection open.
            let _ = open.0.shutdown(Shutdown::Both);
        }
    }

    /// Returns the name of the force field that the service accepts.
    pub fn spelling(&self) -> Spelling {
        self.spelling
    }

    fn command(&self, force: [f64; 3], first: bool) -> String {
        let [x, y, z] = to_service(force);
        let mut message = json!({
            "inverse3": [{
                "device_id": self.id,
                "commands": { "set_cursor_force": { self.spelling.field(): { "x": x, "y": y, "z": z } } },
            }],
        });
        if first && self.spelling == Spelling::Vector {
            message["session"] = json!({ "configure": { "profile": { "name": "pliant" } } });
        }
        message.to_string()
    }

    /// Sends one command and reads one answer.
    ///
    /// A connection on which an answer was missing or incomplete is closed. An answer does not say
    /// which command it belongs to. A late answer would count as the next one, and every position
    /// from then on would be one exchange old.
    fn ask(&mut self, force: [f64; 3]) -> Result<Value, Fault> {
        let command = self.command(force, self.sequence == 0);
        let socket = self.socket.as_mut().ok_or(Fault::Gone)?;
        let answer = socket.send(Message::text(command)).and_then(|()| read(socket));
        match answer {
            Ok(answer) => answer.ok_or(Fault::Malformed),
            Err(error) => {
                self.abandon();
                Err(fault(&error, self.config.timeout))
            }
        }
    }
}

impl HapticDevice for Inverse {
    fn info(&self) -> DeviceInfo {
        DeviceInfo {
            name: "Haply Inverse3".into(),
            serial: self.id.clone(),
            // The maker's data sheet states a peak of 10 N. The rest is a cautious estimate without
            // measurements.
            peak_force: 10.0,
            continuous_force: 3.0,
            peak_torque: 0.0,
            force_axes: [true; 3],
            torque_axes: [false; 3],
            max_stiffness: f64::INFINITY,
            max_damping: f64::INFINITY,
            damping: 0.3,
            friction: 0.1,
            mass: 0.1,
            resolution: 20e-6,
            delay: 1.0 / self.config.rate,
            workspace: [[-0.15, -0.1, -0.1], [0.15, 0.1, 0.1]],
            buttons: 4,
            simulated: false,
        }
    }

    fn calibration(&mut self) -> Calibration {
        if self.status.calibrated {
            Calibration::Ready
        } else {
            Calibration::Needed(
                "calibrate the Inverse3 as its maker says; if its service is older than 3.5, \
                 connect to it anew after that",
            )
        }
    }

    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        scheduler.wait();
        // The service may have let go of a force that was not renewed in time, or the motors may be
        // switched off. The force comes back at zero.
        let idle = self.late || self.renewal.has_lapsed() || !self.status.exerts_force();
        let force = if idle { [0.0; 3] } else { wrench.force };
        let answer = match self.ask(force) {
            // The first command was refused, so the service may know the field by its other name.
            Err(Fault::Gone | Fault::Malformed) if !self.confirmed && !self.switch.0.seen().cut => {
                self.spelling = self.spelling.other();
                self.confirmed = true;
                self.abandon();
                let (socket, _) = connect(&self.config).map_err(|_| Fault::Gone)?;
                self.take(socket)?;
                self.ask(force)?
            }
            other => other?,
        };
        self.confirmed = true;
        self.sequence += 1;
        self.late = self.renewal.renew();
        let device = find(&answer, &self.id).ok_or(Fault::Gone)?;
        self.status = Status::read(device, self.status);
        if !self.status.calibrated {
            return Err(Fault::NotCalibrated);
        }
        let sample = sample(device, &answer, &self.last).ok_or(Fault::Malformed)?;
        self.last = sample;
        Ok(Sample { force_on: self.status.exerts_force() && !(idle || self.late), ..sample })
    }

    fn safe_stop(&mut self) {
        if self.socket.is_some() {
            // What the service does with the last force of a closed connection is not published,
            // so the last one is zero.
            let _ = self.ask([0.0; 3]);
        }
    }

    fn stop_handle(&self) -> Option<Arc<dyn StopHandle>> {
        Some(self.switch.clone())
    }

    fn reopen(&mut self) -> Result<(), Fault> {
        self.abandon();
        if !self.switch.0.begin() {
            return Err(Fault::Gone);
        }
        let (socket, inventory) = connect(&self.config).map_err(|_| Fault::Gone)?;
        (self.id, self.last, self.status) = pick(&self.config, &inventory).map_err(|_| Fault::Gone)?;
        self.take(socket)
    }
}

impl Drop for Inverse {
    fn drop(&mut self) {
        self.safe_stop();
        if let Some(mut socket) = self.socket.take() {
            let _ = socket.close(None);
            let _ = socket.flush();
        }
        self.abandon();
    }
}

impl std::fmt::Debug for Inverse {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Inverse")
            .field("id", &self.id)
            .field("spelling", &self.spelling)
            .finish_non_exhaustive()
    }
}

/// Connects and reads the inventory.
fn connect(config: &InverseConfig) -> Result<(WebSocket<TcpStream>, Value), InverseError> {
    let address = || config.address.clone();
    let refused = |reason: String| InverseError::Connect { address: address(), reason };
    let timeout =
        if config.timeout.is_finite() && config.timeout > 0.0 { config.timeout.min(10.0) } else { 0.1 };
    let timeout = Duration::from_secs_f64(timeout);
    let mut addresses = config.address.to_socket_addrs().map_err(|e| refused(e.to_string()))?;
    let at = addresses.next().ok_or_else(|| refused("no such host".into()))?;
    let stream = TcpStream::connect_timeout(&at, timeout).map_err(|e| refused(e.to_string()))?;
    let set = |stream: &TcpStream| {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(timeout))?;
        stream.set_write_timeout(Some(timeout))
    };
    set(&stream).map_err(|e| refused(e.to_string()))?;
    // An inventory of a few devices has some kilobytes. A service that sends megabytes is invalid.
    let limits = WebSocketConfig::default().max_message_size(Some(1 << 20)).max_frame_size(Some(1 << 20));
    let (mut socket, _) = client_with_config(format!("ws://{}/", config.address), stream, Some(limits))
        .map_err(|e| refused(e.to_string()))?;
    let protocol = |reason: String| InverseError::Protocol { address: address(), reason };
    match read(&mut socket) {
        Ok(Some(inventory)) if inventory.get("inverse3").is_some_and(Value::is_array) => {
            Ok((socket, inventory))
        }
        Ok(_) => Err(protocol("its first message is no inventory with `inverse3`".into())),
        Err(e) => Err(protocol(e.to_string())),
    }
}

/// Reads the next message as JSON. The result is `None` if the message is not JSON.
fn read(socket: &mut WebSocket<TcpStream>) -> Result<Option<Value>, tungstenite::Error> {
    loop {
        match socket.read()? {
            Message::Text(text) => return Ok(serde_json::from_str(text.as_str()).ok()),
            Message::Binary(bytes) => return Ok(serde_json::from_slice(&bytes).ok()),
            Message::Close(_) => return Err(tungstenite::Error::ConnectionClosed),
            _ => {}
        }
    }
}

fn fault(error: &tungstenite::Error, timeout: f64) -> Fault {
    use std::io::ErrorKind;
    match error {
        tungstenite::Error::Io(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
            Fault::Timeout(timeout)
        }
        tungstenite::Error::Capacity(_) | tungstenite::Error::Utf8(_) => Fault::Malformed,
        _ => Fault::Gone,
    }
}

fn ids(inventory: &Value) -> Vec<String> {
    let devices = inventory["inverse3"].as_array().map_or(&[][..], Vec::as_slice);
    devices.iter().filter_map(|d| d["device_id"].as_str()).map(String::from).collect()
}

fn pick(config: &InverseConfig, inventory: &Value) -> Result<(String, Sample, Status), InverseError> {
    let found = ids(inventory);
    let id = match &config.device {
        Some(wanted) => found.iter().find(|id| *id == wanted),
        None => found.first(),
    };
    let Some(id) = id.cloned() else {
        return Err(InverseError::NoDevice {
            address: config.address.clone(),
            wanted: config.device.clone(),
            found,
        });
    };
    let device = find(inventory, &id);
    let last = device.and_then(|d| sample(d, inventory, &Sample::default())).unwrap_or_default();
    let status = device.map_or_else(Status::default, |d| Status::read(d, Status::default()));
    Ok((id, last, status))
}

fn find<'a>(answer: &'a Value, id: &str) -> Option<&'a Value> {
    answer["inverse3"].as_array()?.iter().find(|d| d["device_id"] == id)
}

/// Converts a state to a sample. Parts that the service leaves out keep their last values.
fn sample(device: &Value, answer: &Value, last: &Sample) -> Option<Sample> {
    let state = &device["state"];
    let position = from_service(vector(&state["cursor_position"])?);
    let velocity = vector(&state["cursor_velocity"]).map(from_service);
    // A wired or wireless grip gives the orientation and the buttons. Without a grip there are
    // none.
    let grip =
        ["wireless_verse_grip", "verse_grip"].iter().find_map(|kind| answer[*kind].as_array()?.first());
    let grip = grip.map(|g| &g["state"]);
    let orientation = grip.and_then(|g| quaternion(&g["orientation"])).unwrap_or(last.orientation);
    let pressed = grip.map(|g| buttons(&g["buttons"]));
    Some(Sample {
        position,
        velocity,
        orientation,
        buttons: pressed.unwrap_or(last.buttons),
        force_on: true,
        // The service has no counter that distinguishes a frozen device from a hand at rest.
        sequence: None,
    })
}

fn vector(value: &Value) -> Option<[f64; 3]> {
    Some([value["x"].as_f64()?, value["y"].as_f64()?, value["z"].as_f64()?])
}

fn quaternion(value: &Value) -> Option<[f64; 4]> {
    let [x, y, z] = from_service(vector(value)?);
    Some([x, y, z, value["w"].as_f64()?])
}

/// Reads the buttons `a`, `b`, `c` or `button_0` .. in the order of their names.
fn buttons(value: &Value) -> u32 {
    let Some(map) = value.as_object() else { return 0 };
    let mut names: Vec<_> = map.iter().filter(|(_, v)| v.is_boolean()).collect();
    names.sort_by(|a, b| a.0.cmp(b.0));
    let down = names.iter().enumerate().take(32).filter(|(_, (_, v))| **v == Value::Bool(true));
    down.fold(0, |bits, (i, _)| bits | 1 << i)
}

/// Converts (x right, y away, z up) to (x right, y up, z toward the user).
fn from_service([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x, z, -y]
}

fn to_service([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x, -z, y]
}
