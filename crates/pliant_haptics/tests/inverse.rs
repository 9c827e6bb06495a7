//! The Inverse against a fake service. The service is strict and refuses everything that the
//! vendor's documentation does not allow.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#![cfg(feature = "inverse")]

#[path = "../../pliant_lab/tests/support/fuzzing.rs"]
mod fuzzing;
#[path = "rig/machine.rs"]
mod machine;

use std::{
    net::{TcpListener, TcpStream},
    sync::{Arc, Mutex},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use pliant_haptics::{
    Calibration, Cycle, Fault, HapticDevice, HapticLoop, Inverse, InverseConfig, InverseError, LocalModel,
    LoopConfig, LoopEvent, LoopState, RealScheduler, SafetyConfig, Sample, Spelling, StaleConfig,
    VirtualScheduler, Wrench,
};
use serde_json::{Value, json};
use tungstenite::{Message, WebSocket, accept};

/// Records and commands of the fake service.
#[derive(Default)]
struct Desk {
    forces: Vec<[f64; 3]>,
    refused: Vec<String>,
    position: [f64; 3],
    buttons: bool,
    /// What the messages say about the device beside its state. `Null` is left out.
    status: Value,
    /// Whether only the inventory contains the status.
    status_once: bool,
    /// The service sends this text instead of a state.
    say: Option<String>,
    mute: bool,
    /// The service holds the next answer back while `late` is set. `sent` is set once it has sent
    /// that answer.
    late: bool,
    /// An answer is being held back.
    held: bool,
    sent: bool,
    quit: bool,
    hang_up: bool,
    /// The force on the motors: the last one that was sent, and nothing after the end of the
    /// connection.
    motor: f64,
    /// The largest rise of the force from one command to the next, N.
    rise: f64,
    /// Commands without a force that came while an answer was held back.
    zeros: usize,
}

struct Service {
    address: String,
    desk: Arc<Mutex<Desk>>,
    thread: Option<JoinHandle<()>>,
}

impl Service {
    /// Starts a service of the new or the old version.
    fn start(new: bool) -> Self {
        Self::speaking(new, new)
    }

    /// Starts a service with the inventory of one version and the commands of another.
    fn speaking(inventory: bool, new: bool) -> Self {
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
                            shared.lock().unwrap().motor = 0.0;
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
    fn config(&self) -> InverseConfig {
        InverseConfig { address: self.address.clone(), timeout: 10.0, ..InverseConfig::default() }
    }

    /// Releases the answer that was held back and waits until it is sent.
    fn send_late(&self) {
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

    fn desk(&self) -> std::sync::MutexGuard<'_, Desk> {
        self.desk.lock().unwrap()
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.desk().quit = true;
        self.thread.take().unwrap().join().unwrap();
    }
}

fn state(desk: &Desk, new: bool) -> Value {
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

fn pacing() -> RealScheduler {
    RealScheduler::new(pliant_haptics::LoopClock::start(), 1000.0)
}

fn second(config: InverseConfig) -> InverseConfig {
    InverseConfig { device: Some("049D".into()), ..config }
}

#[test]
fn both_spellings_and_the_axes() {
    for (new, want) in [(true, Spelling::Vector), (false, Spelling::Values)] {
        let service = Service::start(new);
        assert_eq!(Inverse::list(&service.config()).unwrap(), ["04BA", "049D"]);
        service.desk().position = [0.01, 0.02, 0.03];
        service.desk().buttons = true;
        let mut device = Inverse::open(second(service.config())).unwrap();
        assert_eq!(device.spelling(), want);
        // A force of 1 N right, 2 N up, 3 N toward the user is (1, -3, 2) for the service.
        let sample =
            device.exchange(&Wrench { force: [1.0, 2.0, 3.0], ..Wrench::ZERO }, &mut pacing()).unwrap();
        assert_eq!(service.desk().forces, [[1.0, -3.0, 2.0]]);
        assert_eq!(sample.position, [0.01, 0.03, -0.02]);
        assert_eq!(sample.velocity, Some([0.1, 0.3, -0.2]));
        assert_eq!(sample.orientation, [0.5, 0.5, -0.5, 0.5]);
        assert_eq!(sample.buttons, 0b101);
        drop(device);
        assert_eq!(service.desk().forces.last(), Some(&[0.0, -0.0, 0.0]), "the last word is no force");
        assert_eq!(service.desk().refused, [""; 0]);
    }
}

#[test]
fn a_wrong_guess_is_put_right() {
    // These services use another field name than their inventory suggests. They refuse the first
    // command and accept the second.
    for (inventory, new, want) in [(true, false, Spelling::Values), (false, true, Spelling::Vector)] {
        let service = Service::speaking(inventory, new);
        let mut device = Inverse::open(second(service.config())).unwrap();
        assert!(device.exchange(&Wrench { force: [1.0, 0.0, 0.0], ..Wrench::ZERO }, &mut pacing()).is_ok());
        assert_eq!(device.spelling(), want);
        assert_eq!(service.desk().forces, [[1.0, -0.0, 0.0]]);
        assert_eq!(service.desk().refused.len(), 1);
    }
    // The user's setting applies, whether it is right or wrong.
    let service = Service::start(true);
    let told = InverseConfig { spelling: Some(Spelling::Values), ..second(service.config()) };
    let mut device = Inverse::open(told).unwrap();
    assert!(device.exchange(&Wrench::ZERO, &mut pacing()).is_err());
    assert_eq!(device.spelling(), Spelling::Values);
}

#[test]
fn the_loop_feels_a_spring_through_it() {
    let service = Service::start(true);
    service.desk().position = [0.004, 0.0, 0.0];
    let device = Inverse::open(second(service.config())).unwrap();
    let mut cycle = Cycle::new(device, LoopConfig::default()).unwrap();
    // In virtual time an answer is in time, however long a busy machine takes for it.
    let mut scheduler = VirtualScheduler::new(1000.0);
    let mut events: Vec<LoopEvent> = Vec::new();
    let mut model = LocalModel { count: 1, period: 0.01, ..LocalModel::default() };
    model.contacts[0].stiffness = [[100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]];
    let mut step = |cycle: &mut Cycle<Inverse>, events: &mut Vec<LoopEvent>| {
        model.tick += 1;
        cycle.step(&mut scheduler, &model, events);
        cycle.core().last().wrench.force[0]
    };
    for _ in 0..400 {
        step(&mut cycle, &mut events);
    }
    assert_eq!((cycle.core().last().gain, cycle.core().last().fault), (1.0, None), "after the ramp");
    let force = cycle.core().last().wrench.force;
    assert!((force[0] + 0.4).abs() < 1e-3, "100 N/m over 4 mm: {force:?}");
    // The device disappears in the middle of the grab and comes back by itself.
    service.desk().hang_up = true;
    let lost = (0..200).any(|_| {
        step(&mut cycle, &mut events);
        events.contains(&LoopEvent::Lost)
    });
    assert!(lost, "{events:?}");
    service.desk().hang_up = false;
    let returned = (0..10_000).any(|_| {
        step(&mut cycle, &mut events);
        events.contains(&LoopEvent::Returned)
    });
    assert!(returned, "{events:?}");
    let (mut largest, mut last) = (0.0f64, cycle.core().last().wrench.force[0]);
    for _ in 0..400 {
        let force = step(&mut cycle, &mut events);
        largest = largest.max(last - force);
        last = force;
    }
    // 0.4 N in 300 ms are 1.3 mN per period.
    assert!(last < -0.3 && largest < 0.002, "comes back by the ramp: {last} N, steps of {largest} N");
    assert_eq!(service.desk().refused, [""; 0]);
}

/// The `status` of a device that is ready, as the service's documentation shows it.
fn ready() -> Value {
    json!({ "calibrated": true, "in_use": true, "power_supply": true, "ready": true, "started": true })
}

/// A loop in virtual time whose hand stretches a spring of 100 N/m by 4 mm.
struct Pulled {
    cycle: Cycle<Inverse>,
    scheduler: VirtualScheduler,
    model: LocalModel,
    events: Vec<LoopEvent>,
}

impl Pulled {
    fn new(service: &Service) -> Self {
        service.desk().position = [0.004, 0.0, 0.0];
        let device = Inverse::open(second(service.config())).unwrap();
        let mut model = LocalModel { count: 1, period: 0.01, ..LocalModel::default() };
        model.contacts[0].stiffness = [[100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]];
        Self {
            cycle: Cycle::new(device, LoopConfig::default()).unwrap(),
            scheduler: VirtualScheduler::new(1000.0),
            model,
            events: Vec::new(),
        }
    }

    fn run(&mut self, periods: usize) {
        for _ in 0..periods {
            self.model.tick += 1;
            self.cycle.step(&mut self.scheduler, &self.model, &mut self.events);
        }
    }
}

/// Says by `field` of the status that something is missing, for a while in the middle of a grab.
/// Returns the events of that while.
#[track_caller]
fn without(field: &str, want: LoopState) -> Vec<LoopEvent> {
    let service = Service::start(true);
    service.desk().status = ready();
    let mut pulled = Pulled::new(&service);
    pulled.run(400);
    let before = service.desk().motor;
    assert!((before - 0.4).abs() < 1e-3, "{field}: {before} N before");
    pulled.events.clear();
    service.desk().status[field] = json!(false);
    // The answer to the first command says it, and the second command is without a force.
    pulled.run(2);
    let at_once = service.desk().motor;
    pulled.run(400);
    let meanwhile = service.desk().motor;
    println!("Inverse without `{field}`: {before:.3} N, then {at_once:.3} N, {meanwhile:.3} N in the end");
    assert_eq!((at_once, meanwhile), (0.0, 0.0), "{field}: no force is sent");
    assert_eq!(pulled.cycle.report().state, want, "{field}");
    let events = std::mem::take(&mut pulled.events);
    service.desk().rise = 0.0;
    service.desk().status = ready();
    pulled.run(1000);
    let after = service.desk().motor;
    let rise = service.desk().rise;
    println!("Inverse with `{field}` again: {after:.3} N, rises by at most {rise:.4} N a period");
    assert!((after - 0.4).abs() < 1e-3, "{field}: {after} N afterwards");
    // The ramp brings the peak force of 10 N in 0.3 s, and 0.4 N are 1.3 mN per period.
    assert!(rise < 0.002, "{field}: by the ramp, not by a kick of {rise} N");
    assert_eq!(pulled.cycle.report().state, LoopState::Running, "{field}");
    assert_eq!(service.desk().refused, [""; 0]);
    events
}

#[test]
fn an_inverse_that_loses_its_calibration_exerts_no_force() {
    let events = without("calibrated", LoopState::Calibrating);
    assert!(events.contains(&LoopEvent::Fault(Fault::NotCalibrated)), "{events:?}");
    assert!(events.iter().any(|e| matches!(e, LoopEvent::Calibrate(_))), "{events:?}");
}

#[test]
fn an_inverse_without_power_or_not_ready_is_switched_off() {
    for field in ["power_supply", "ready"] {
        let events = without(field, LoopState::ForceOff);
        assert!(events.contains(&LoopEvent::Fault(Fault::ForceOff)), "{field}: {events:?}");
    }
}

#[test]
fn an_inverse_is_not_calibrated_until_a_message_says_so() {
    for (once, says) in [(false, true), (true, false)] {
        let service = Service::start(true);
        let mut status = ready();
        status["calibrated"] = json!(false);
        service.desk().status = status;
        // A service that says it in its inventory only is believed until the next connection.
        service.desk().status_once = once;
        let mut pulled = Pulled::new(&service);
        assert!(matches!(pulled.cycle.device_mut().calibration(), Calibration::Needed(_)));
        pulled.run(400);
        assert!(service.desk().forces.iter().flatten().all(|x| *x == 0.0), "no force before");
        if says {
            service.desk().status = ready();
        }
        pulled.run(1000);
        let motor = service.desk().motor;
        assert_eq!(motor > 0.39, says, "{motor} N");
        service.desk().status_once = false;
        service.desk().status = ready();
        pulled.cycle.device_mut().reopen().unwrap();
        pulled.run(1000);
        let motor = service.desk().motor;
        assert!(motor > 0.39, "{motor} N after a new connection");
    }
}

#[test]
fn nonsense_and_silence() {
    let service = Service::start(true);
    let config = second(service.config());
    let mut device = Inverse::open(config.clone()).unwrap();
    let mut scheduler = pacing();
    assert!(device.exchange(&Wrench::ZERO, &mut scheduler).is_ok());
    for (nonsense, want) in [
        ("not json", Fault::Malformed),
        ("{\"inverse3\": 3}", Fault::Gone),
        ("{\"inverse3\": []}", Fault::Gone),
        ("{\"inverse3\": [{\"device_id\": \"049D\", \"state\": {}}]}", Fault::Malformed),
        (
            "{\"inverse3\": [{\"device_id\": \"049D\", \"state\": {\"cursor_position\": {\"x\": \"a\"}}}]}",
            Fault::Malformed,
        ),
    ] {
        service.desk().say = Some(nonsense.into());
        assert_eq!(device.exchange(&Wrench::ZERO, &mut scheduler).unwrap_err(), want, "{nonsense}");
    }
    service.desk().say = None;
    drop(device);
    let mut device = hasty(&service);
    assert!(answer(&mut device).position[0].abs() < 1e-9);
    service.desk().mute = true;
    assert_eq!(device.exchange(&Wrench::ZERO, &mut scheduler).unwrap_err(), Fault::Timeout(HASTE));
    drop(device);
    service.desk().mute = false;
    let missing = Inverse::open(InverseConfig { device: Some("FFFF".into()), ..config });
    assert!(
        matches!(missing, Err(InverseError::NoDevice { ref found, .. }) if found.len() == 2),
        "{missing:?}"
    );
    let nobody = machine::Nobody::new();
    let nobody = Inverse::open(InverseConfig { address: nobody.address.clone(), ..InverseConfig::default() });
    assert!(matches!(nobody, Err(InverseError::Connect { .. })), "{nobody:?}");
}

#[test]
fn no_text_of_the_service_panics_the_driver() {
    let service = Service::start(true);
    let mut device = Inverse::open(second(service.config())).unwrap();
    let mut scheduler = pacing();
    let grip = r#"{"inverse3": [{"device_id": "049D", "state": {"cursor_position": {"x": 1e300, "y": -0.0,
        "z": 5e-324}, "cursor_velocity": {"x": 1, "y": 2}}}], "verse_grip": [{"state": {"orientation": {"w": 1,
        "x": 0, "y": 0, "z": 0}, "buttons": {"button_0": true, "button_1": false}}}]}"#;
    let corpus = vec![state(&service.desk(), true).to_string().into_bytes(), grip.as_bytes().to_vec()];
    // The target has no state of its own that an error could leave in two minds.
    let device = std::cell::RefCell::new((&mut device, &mut scheduler));
    fuzzing::run("inverse", corpus, |bytes| {
        service.desk().say = Some(String::from_utf8_lossy(bytes).into_owned());
        let (device, scheduler) = &mut *device.borrow_mut();
        match device.exchange(&Wrench::ZERO, *scheduler) {
            Ok(sample) => {
                let numbers = sample.position.iter().chain(&sample.orientation);
                assert!(numbers.chain(sample.velocity.iter().flatten()).all(|x| x.is_finite()));
            }
            Err(fault) => assert!(matches!(fault, Fault::Malformed | Fault::Gone), "{fault:?}"),
        }
    });
    assert_eq!(service.desk().refused, [""; 0]);
}

/// Timeout for tests that wait until it expires, s.
const HASTE: f64 = 0.2;

/// Opens a device with the timeout [`HASTE`]. A busy service may need more than one try.
fn hasty(service: &Service) -> Inverse {
    let config = InverseConfig { timeout: HASTE, ..second(service.config()) };
    machine::until("a connection in time", || Inverse::open(config.clone()))
}

/// Exchanges until an answer comes in time. As the loop does, the function reopens a device that is
/// gone.
fn answer(device: &mut Inverse) -> Sample {
    machine::until("an answer in time", || {
        let answer = device.exchange(&Wrench::ZERO, &mut pacing());
        answer.inspect_err(|_| {
            let _ = device.reopen();
        })
    })
}

#[test]
fn a_late_renewal_sends_zero_first() {
    let service = Service::start(true);
    let mut device = Inverse::open(second(service.config())).unwrap();
    let pull = Wrench { force: [1.0, 0.0, 0.0], ..Wrench::ZERO };
    let pulls = |device: &mut Inverse| {
        machine::until("1 N on the motors", || {
            let sample = device.exchange(&pull, &mut pacing());
            let motor = service.desk().motor;
            if sample.is_ok_and(|s| s.force_on) && motor == 1.0 { Ok(()) } else { Err(sample) }
        });
    };
    pulls(&mut device);
    std::thread::sleep(Duration::from_millis(40));
    let late = device.exchange(&pull, &mut pacing()).unwrap();
    let motor = service.desk().motor;
    println!("Inverse: {motor} N after a late renewal");
    assert_eq!((motor, late.force_on), (0.0, false), "a force that may be off comes back at zero");
    pulls(&mut device);
}

#[test]
fn a_late_answer_is_not_taken_for_the_next_one() {
    let service = Service::start(true);
    let mut device = hasty(&service);
    answer(&mut device);
    service.desk().late = true;
    assert_eq!(device.exchange(&Wrench::ZERO, &mut pacing()).unwrap_err(), Fault::Timeout(HASTE));
    service.send_late();
    for k in 1..=100 {
        let x = 1e-4 * f64::from(k);
        service.desk().position = [x, 0.0, 0.0];
        let off = (answer(&mut device).position[0] - x).abs();
        assert!(off < 1e-9, "where the hand is now, not an exchange ago: off by {off} m");
    }
    // A stop whose answer is late must not leave that answer behind either.
    service.desk().late = true;
    device.safe_stop();
    service.send_late();
    answer(&mut device);
    service.desk().position = [0.07, 0.0, 0.0];
    assert!((answer(&mut device).position[0] - 0.07).abs() < 1e-9);
}

/// A running loop and the game that publishes a spring of 200 N/m to the center.
struct Game {
    running: HapticLoop,
    tick: u64,
}

impl Game {
    /// Starts the loop on a device whose simulation may be late by 0.2 s.
    fn start(config: InverseConfig) -> Self {
        let device = Inverse::open(config).unwrap();
        let stale = Some(StaleConfig { patience: 0.2, limit: 0.25 });
        let safety = SafetyConfig { stale, ..SafetyConfig::for_device(&device.info(), 1000.0) };
        let config = LoopConfig { safety: Some(safety), ..LoopConfig::default() };
        Self { running: HapticLoop::start(device, config).unwrap(), tick: 0 }
    }

    fn publish(&mut self) {
        self.tick += 1;
        self.running.publish(|model| {
            (model.tick, model.period, model.count) = (self.tick, 0.01, 1);
            model.contacts[0].stiffness = [[200.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 200.0]];
        });
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Waits for 1 N on the motors, while `step` lets time pass.
fn pulled(service: &Service, mut step: impl FnMut()) {
    machine::until("1 N on the motors", || {
        step();
        let force = service.desk().motor;
        if (force - 1.0).abs() < 1e-3 { Ok(()) } else { Err(force) }
    });
}

/// Makes the service hold its next answer back, and waits until it does.
fn hold_back(service: &Service) {
    service.desk().late = true;
    machine::until("an answer is held back", || {
        std::thread::sleep(Duration::from_micros(200));
        if service.desk().held { Ok(()) } else { Err("no command has come") }
    });
}

/// Returns the time from now to a force of zero on the motors, s, at most 1.
fn seconds_to_zero(service: &Service) -> f64 {
    let begun = Instant::now();
    while service.desk().motor > 0.0 && begun.elapsed().as_secs_f64() < 1.0 {
        std::thread::sleep(Duration::from_micros(200));
    }
    begun.elapsed().as_secs_f64()
}

#[test]
fn a_service_that_does_not_answer_loses_its_force() {
    let service = Service::start(true);
    service.desk().position = [0.005, 0.0, 0.0];
    let mut game = Game::start(second(service.config()));
    let mut times = Vec::new();
    while times.len() < 5 && times.last().is_none_or(|t| *t > 0.05) {
        pulled(&service, || game.publish());
        hold_back(&service);
        times.push(seconds_to_zero(&service));
        service.desk().late = false;
        assert!(times.iter().all(|t| *t < 1.0), "the force is still on after {times:?} s");
    }
    println!("Inverse: force zero after {times:?} s, {} commands for it", service.desk().zeros);
    assert!(times.iter().any(|t| *t <= 0.05), "{times:?} s");
    // A device that hangs is dropped in time as well.
    pulled(&service, || game.publish());
    hold_back(&service);
    let begun = Instant::now();
    drop(game);
    let took = begun.elapsed().as_secs_f64();
    println!("Inverse: dropped after {took:.3} s");
    assert!(took <= 1.0, "{took} s");
    assert!(seconds_to_zero(&service) < 1.0, "no force is left behind");
    // What a service does with the force of a closed connection is not published.
    let zeros = service.desk().zeros;
    assert_eq!(zeros, times.len() + 1, "each connection ends with a command without a force");
    service.desk().late = false;
}

/// The game in a process of its own, for [`a_process_that_dies`].
#[test]
#[ignore = "is run by another test, in a process of its own"]
fn a_game() {
    let Ok(address) = std::env::var("PLIANT_TEST_SERVICE") else { return };
    let mut game = Game::start(second(InverseConfig { address, timeout: 10.0, ..InverseConfig::default() }));
    loop {
        game.publish();
    }
}

#[test]
fn a_process_that_dies() {
    let service = Service::start(true);
    service.desk().position = [0.005, 0.0, 0.0];
    let mut child = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "a_game", "--ignored"])
        .env("PLIANT_TEST_SERVICE", &service.address)
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    pulled(&service, || std::thread::sleep(Duration::from_millis(1)));
    child.kill().unwrap();
    child.wait().unwrap();
    // The system closes the connection. That a real service then lets go of the force is assumed.
    let took = seconds_to_zero(&service);
    println!("Inverse, KILL: connection closed after {:.1} ms", 1e3 * took);
    assert!(took < 0.2, "{took} s");
}
