//! A fake service of the Inverse3. It refuses everything that the documentation does not allow.

use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use pliant_haptics::InverseConfig;
use serde_json::{Value, json};
use tungstenite::{Message, WebSocket, accept};

use super::machine;

/// Records and commands of the fake service.
#[derive(Default)]
pub(super) struct Desk {
    pub(super) forces: Vec<[f64; 3]>,
    pub(super) refused: Vec<String>,
    pub(super) position: [f64; 3],
    pub(super) buttons: bool,
    /// What the messages say about the device beside its state. `Null` is left out.
    pub(super) status: Value,
    /// Whether only the inventory contains the status.
    pub(super) status_once: bool,
    /// The service sends this text instead of a state.
    pub(super) say: Option<String>,
    pub(super) mute: bool,
    /// The service holds the next answer back while `late` is set. `sent` is set once it has sent
    /// that answer.
    pub(super) late: bool,
    /// An answer is being held back.
    pub(super) held: bool,
    pub(super) sent: bool,
    /// The service does not greet who connects. `waits` says that somebody has.
    pub(super) unfriendly: bool,
    pub(super) waits: bool,
    pub(super) quit: bool,
    pub(super) hang_up: bool,
    /// Number of connections that have ended.
    pub(super) ended: usize,
    /// The force on the motors: the last one that was sent, and nothing after the end of the
    /// connection.
    pub(super) motor: f64,
    /// The largest rise of the force from one command to the next, N.
    pub(super) rise: f64,
    /// Commands without a force that came while an answer was held back.
    pub(super) zeros: usize,
}

pub(super) struct Service {
    pub(super) address: String,
    pub(super) desk: Arc<Mutex<Desk>>,
    pub(super) thread: Option<JoinHandle<()>>,
}

impl Service {
    /// Starts a service of the new or the old version.
    pub(super) fn start(new: bool) -> Self {
        Self::speaking(new, new)
    }

    /// Starts a service with the inventory of one version and the commands of another.
    pub(super) fn speaking(inventory: bool, new: bool) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let desk = Arc::new(Mutex::new(Desk::default()));
        let shared = desk.clone();
        let thread = std::thread::spawn(move || {
            listener.set_nonblocking(true).unwrap();
            while !shared.lock().unwrap().quit {
                match listener.accept() {
                    Ok((stream, _)) => {
                        stream.set_nonblocking(false).unwrap();
                        // A client that has connected either starts the handshake or disconnects,
                        // and may take any time for it.
                        if let Ok(socket) = accept(stream) {
                            let end = socket.get_ref();
                            end.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
                            serve(socket, &shared, inventory, new);
                            let mut desk = shared.lock().unwrap();
                            (desk.motor, desk.ended) = (0.0, desk.ended + 1);
                        }
                    }
                    Err(_) => std::thread::sleep(Duration::from_millis(2)),
                }
            }
        });
        Self { address, desk, thread: Some(thread) }
    }

    /// Returns a configuration with the longest effective timeout. No answer is late, and a refusal
    /// is still immediate.
    pub(super) fn config(&self) -> InverseConfig {
        InverseConfig { address: self.address.clone(), timeout: 10.0, ..InverseConfig::default() }
    }

    /// Releases the answer that was held back and waits until it is sent.
    pub(super) fn send_late(&self) {
        machine::until("an answer is held back", || {
            std::thread::sleep(Duration::from_millis(1));
            if self.desk().held { Ok(()) } else { Err("no command has come") }
        });
        self.desk().late = false;
        machine::until("the late answer is sent", || {
            std::thread::sleep(Duration::from_millis(1));
            if std::mem::take(&mut self.desk().sent) { Ok(()) } else { Err("held back") }
        });
    }

    pub(super) fn desk(&self) -> std::sync::MutexGuard<'_, Desk> {
        self.desk.lock().unwrap()
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.desk().quit = true;
        self.thread.take().unwrap().join().unwrap();
    }
}

pub(super) fn state(desk: &Desk, new: bool) -> Value {
    let [x, y, z] = desk.position;
    let mut message = json!({
        "inverse3": [
            { "device_id": "04BA", "state": { "cursor_position": { "x": 9.0, "y": 9.0, "z": 9.0 } } },
            { "device_id": "049D", "state": {
                "cursor_position": { "x": x, "y": y, "z": z },
                "cursor_velocity": { "x": 0.1, "y": 0.2, "z": 0.3 },
            } },
        ],
        "wireless_verse_grip": [{ "device_id": "61576", "state": {
            "orientation": { "w": 0.5, "x": 0.5, "y": 0.5, "z": 0.5 },
            "buttons": { "a": desk.buttons, "b": false, "c": true },
        } }],
    });
    if !desk.status.is_null() {
        message["inverse3"][1]["status"] = desk.status.clone();
    }
    if new {
        message["session_id"] = json!(7);
    }
    message
}

/// Serves one connection: an inventory, then exactly one state per command. A command that differs
/// from the documentation ends the connection.
fn serve(mut socket: WebSocket<TcpStream>, shared: &Mutex<Desk>, inventory: bool, new: bool) {
    while shared.lock().is_ok_and(|mut desk| {
        desk.waits = desk.unfriendly && !desk.quit;
        desk.waits
    }) {
        std::thread::sleep(Duration::from_millis(1));
    }
    let inventory = state(&shared.lock().unwrap(), inventory).to_string();
    if socket.send(Message::text(inventory)).is_err() {
        return;
    }
    let mut first = true;
    loop {
        if shared.lock().unwrap().quit || shared.lock().unwrap().hang_up {
            return;
        }
        let text = match socket.read() {
            Ok(Message::Text(text)) => text,
            Err(tungstenite::Error::Io(e))
                if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) =>
            {
                continue;
            }
            Ok(_) => continue,
            Err(_) => return,
        };
        let mut desk = shared.lock().unwrap();
        match check(text.as_str(), new, first) {
            Ok(force) => {
                let motor = force.iter().map(|x| x * x).sum::<f64>().sqrt();
                desk.rise = desk.rise.max(motor - desk.motor);
                desk.motor = motor;
                desk.forces.push(force);
            }
            Err(why) => {
                desk.refused.push(why);
                let _ = socket.close(None);
                return;
            }
        }
        first = false;
        if desk.status_once {
            desk.status = Value::Null;
        }
        if desk.mute {
            continue;
        }
        let answer = desk.say.clone().unwrap_or_else(|| state(&desk, new).to_string());
        let late = desk.late;
        drop(desk);
        while shared.lock().is_ok_and(|mut desk| {
            desk.held = desk.late && !desk.quit;
            desk.held
        }) {
            std::thread::sleep(Duration::from_millis(1));
            // A service reads its connections while it works for one of them.
            let mut rest = [0; 1024];
            let end = socket.get_mut();
            end.set_nonblocking(true).unwrap();
            let came = end.peek(&mut rest);
            end.set_nonblocking(false).unwrap();
            match came {
                Ok(0) => shared.lock().unwrap().motor = 0.0,
                Ok(n) => {
                    let text = String::from_utf8_lossy(&rest[..n]).into_owned();
                    // A frame whose mask is zero can be read as it is.
                    if let Some(json) = text.find('{').map(|at| &text[at..])
                        && let Some(Ok(message)) =
                            serde_json::Deserializer::from_str(json).into_iter::<Value>().next()
                        && check(&message.to_string(), new, false).is_ok_and(|f| f.iter().all(|x| *x == 0.0))
                    {
                        let mut desk = shared.lock().unwrap();
                        desk.zeros += 1;
                        desk.motor = 0.0;
                        drop(desk);
                        // What was peeked at is taken, so that the end of the connection shows.
                        use std::io::Read;
                        let _ = socket.get_mut().read(&mut rest);
                    }
                }
                Err(_) => {}
            }
        }
        let sent = socket.send(Message::text(answer));
        shared.lock().unwrap().sent = late;
        if sent.is_err() {
            return;
        }
    }
}

/// Accepts only the documented command: every key is known, every number is present, and the device
/// is one of the service's.
fn check(text: &str, new: bool, first: bool) -> Result<[f64; 3], String> {
    let message: Value = serde_json::from_str(text).map_err(|e| e.to_string())?;
    let keys =
        |v: &Value| -> Vec<String> { v.as_object().map(|m| m.keys().cloned().collect()).unwrap_or_default() };
    let field = if new { "vector" } else { "values" };
    for key in keys(&message) {
        // The first message alone may configure a session, and only newer services know this key.
        if key != "inverse3" && !(key == "session" && new && first) {
            return Err(format!("unknown key {key}"));
        }
    }
    let devices = message["inverse3"].as_array().ok_or("no list of devices")?;
    let [device] = devices.as_slice() else { return Err("not one device".into()) };
    if keys(device) != ["commands", "device_id"] || device["device_id"] != "049D" {
        return Err(format!("device {device}"));
    }
    let command = &device["commands"];
    if keys(command) != ["set_cursor_force"] || keys(&command["set_cursor_force"]) != [field] {
        return Err(format!("command {command}"));
    }
    let force = &command["set_cursor_force"][field];
    if keys(force) != ["x", "y", "z"] {
        return Err(format!("force {force}"));
    }
    let number = |k: &str| force[k].as_f64().ok_or(format!("{k} is no number"));
    Ok([number("x")?, number("y")?, number("z")?])
}
