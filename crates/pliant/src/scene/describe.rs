//! The content of a scene file, field by field.

use serde::Deserialize;

use crate::modal::StepSettings;

/// A scene: bodies, the hands on them, and what the app adds for the scene.
///
/// Lengths are in m, times are in s, and y is up. Every field except `bodies` may be left out.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(rename = "Scene", deny_unknown_fields)]
pub struct SceneDescription {
    /// Title of the scene, for people. Default: empty.
    #[serde(default)]
    pub title: String,
    /// Ticks per second, 1 to 2000: the rate of `Time<Fixed>`. Default: `None`, the rate of the
    /// app.
    ///
    /// Only [`SceneFilePlugin::open`](super::SceneFilePlugin::open) sets the rate. A game that
    /// loads the scene as an asset keeps its own rate.
    #[serde(default)]
    pub step_hz: Option<f64>,
    /// Suggested view of a camera. Default: `None`. The plugin spawns no camera; the app may apply
    /// the view.
    #[serde(default)]
    pub view: Option<ViewEntry>,
    /// The soft bodies, at most [`MAX_BODIES`](super::MAX_BODIES) with their copies.
    pub bodies: Vec<BodyEntry>,
    /// Hands that play a script, at most [`MAX_GRABS`](super::MAX_GRABS). Default: none.
    #[serde(default)]
    pub grabs: Vec<GrabEntry>,
    /// A session. Default: `None`.
    #[serde(default)]
    pub network: Option<NetworkEntry>,
    /// A haptic device. Default: `None`.
    #[serde(default)]
    pub device: Option<DeviceEntry>,
    /// A recording for the rerun viewer. Default: `None`.
    #[serde(default)]
    pub recording: Option<RecordingEntry>,
}

/// A camera's position around a point.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "View", deny_unknown_fields)]
pub struct ViewEntry {
    /// Point that the camera looks at, m.
    pub middle: [f64; 3],
    /// Distance of the camera from that point, m, above 0.
    pub distance: f64,
    /// Angle about the vertical, degrees; 0 looks along -z. Default: 25.
    #[serde(default = "yaw")]
    pub yaw: f64,
    /// Angle above the horizon, degrees. Default: 13.
    #[serde(default = "pitch")]
    pub pitch: f64,
}

fn yaw() -> f64 {
    25.0
}

fn pitch() -> f64 {
    13.0
}

/// A soft body, made of a `model` or of a `bake`.
///
/// In a scene that joins a session, neither is needed, because the host sends the body.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Body", deny_unknown_fields)]
pub struct BodyEntry {
    /// Name of the body, 1 to 64 bytes, unique in the scene; also its name in a session and in a
    /// recording.
    pub name: String,
    /// A baked body: the path of a `.modal` file under the folder of assets.
    #[serde(default)]
    pub model: Option<String>,
    /// A body that is baked when the scene begins (feature `bake`).
    #[serde(default)]
    pub bake: Option<BakeEntry>,
    /// Transform of the body and its anchors. Default: at the origin.
    #[serde(default)]
    pub place: TransformEntry,
    /// Several copies of the body in rows, named `NAME.0`, `NAME.1`, row after row. Default:
    /// `None`, one body named `NAME`.
    #[serde(default)]
    pub copies: Option<CopiesEntry>,
    /// Red, green, blue, 0 to 1 (sRGB); drawn with the feature `render`. Default: a warm clay.
    #[serde(default = "color")]
    pub color: [f64; 3],
    /// Roughness of the surface's look, 0 to 1. Default: 0.45.
    #[serde(default = "roughness")]
    pub roughness: f64,
    /// How the body is stepped: `settings: (stiffness_scale: 4, gravity: (0, -9.81, 0))`. Default:
    /// all defaults of [`StepSettings`].
    #[serde(default)]
    pub settings: StepSettings,
    /// Number of modes that are kept, at least 1. Default: `None`, all.
    #[serde(default)]
    pub modes: Option<usize>,
    /// Whether the processor writes the surface from a basis in half precision
    /// ([`ModalBody::half_basis`](crate::body::ModalBody::half_basis)). Default: false.
    #[serde(default)]
    pub half_basis: bool,
    /// Speed below which the body comes to rest, m/s; 0 never rests. Default: `None`, the default
    /// of [`ModalBody::rest_speed`](crate::body::ModalBody::rest_speed).
    #[serde(default)]
    pub rest_speed: Option<f64>,
    /// Whether the pointer may pull the body. Default: true.
    #[serde(default = "yes")]
    pub pointer: bool,
    /// Whether the body is in the session. Default: `None`, true if the scene has a `network`.
    #[serde(default)]
    pub shared: Option<bool>,
}

fn color() -> [f64; 3] {
    [0.95, 0.50, 0.36]
}

fn roughness() -> f64 {
    0.45
}

fn yes() -> bool {
    true
}

fn one() -> f64 {
    1.0
}

/// A body that is baked when the scene begins and kept in the user's cache folder.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Bake", deny_unknown_fields)]
pub struct BakeEntry {
    /// Path of the shape under the folder of assets.
    ///
    /// The shape is a surface (`.obj`, `.stl`, `.ply`, `.gltf`, `.glb`), a body of rounded parts
    /// (`.ron`) or tetrahedra (`.msh`, `.vtk`, `.mesh`, `.veg`).
    pub shape: String,
    /// Approximate number of tetrahedra, 10 to 200,000. Default: 4000.
    #[serde(default = "tets")]
    pub tets: usize,
    /// Number of coordinates, 1 to 120, or of modes of a linear body, 1 to 500. Default: 36.
    #[serde(default = "bake_modes")]
    pub modes: usize,
    /// Material for large strains: `"neo-hookean"`, `"st-venant-kirchhoff"`, or `"linear"` for
    /// none. Default: neo-Hookean.
    #[serde(default = "bake_material")]
    pub material: String,
    /// Young's modulus, Pa, 1e-3 to 1e15. Default: 1e5, a soft silicone.
    #[serde(default = "young")]
    pub young: f64,
    /// Poisson ratio, -0.99 to 0.45, and to 0.49999 for a linear body. Default: 0.4.
    #[serde(default = "poisson")]
    pub poisson: f64,
    /// Density, kg/m^3, 1e-6 to 1e7. Default: 1000.
    #[serde(default = "density")]
    pub density: f64,
    /// Damping ratio of every mode (1 is critical damping), 0 to 1000. Default: 0.03.
    #[serde(default = "damping_ratio")]
    pub damping_ratio: f64,
    /// Half-spaces that are fixed, such as `"y<0.02"`, beside what is painted in the file. Default:
    /// none, which gives a free body.
    #[serde(default)]
    pub anchors: Vec<String>,
    /// Parts that are stiffer or heavier, such as `"y>0.2 & x<0: stiffness 50, density 1.5"`, at
    /// most 64. Default: none.
    #[serde(default)]
    pub regions: Vec<String>,
}

fn tets() -> usize {
    4000
}

fn bake_modes() -> usize {
    36
}

fn bake_material() -> String {
    "neo-hookean".into()
}

fn young() -> f64 {
    1e5
}

fn poisson() -> f64 {
    0.4
}

fn density() -> f64 {
    1000.0
}

fn damping_ratio() -> f64 {
    0.03
}

/// A position, an orientation and a scale.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "Place", deny_unknown_fields)]
pub struct TransformEntry {
    /// Position, m. Default: the origin.
    #[serde(default)]
    pub at: [f64; 3],
    /// Rotation about x, then y, then z, degrees. Default: none.
    #[serde(default)]
    pub turn: [f64; 3],
    /// Scale relative to the baked size, 0.001 to 1000. Default: 1.
    #[serde(default = "one")]
    pub scale: f64,
}

impl Default for TransformEntry {
    fn default() -> Self {
        Self { at: [0.0; 3], turn: [0.0; 3], scale: 1.0 }
    }
}

/// Copies of a body in rows and columns on the ground, centered at the entry's place.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "Copies", deny_unknown_fields)]
pub struct CopiesEntry {
    /// Number of copies along x and along z, each 1 or more.
    pub count: [usize; 2],
    /// Distance between copies along x and along z, m.
    pub spacing: [f64; 2],
}

/// A hand that holds a patch of a body and moves by a script.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Grab", deny_unknown_fields)]
pub struct GrabEntry {
    /// Name of the grab, 1 to 64 bytes, unique in the scene; messages, recordings and the panel
    /// show it.
    pub name: String,
    /// Name of the body that the hand holds (`NAME.0` for a body with copies).
    pub body: String,
    /// The part of the surface that the hand holds.
    pub patch: PatchEntry,
    /// Radius of the patch on the rest shape, m of the model. Default: `None`, 6 % of the body's
    /// size.
    #[serde(default)]
    pub radius: Option<f64>,
    /// Offset of the hand's target from where it took hold, m, in the scene's axes. Default: zero.
    #[serde(default)]
    pub pull: [f64; 3],
    /// Motion of the hand about that offset. Default: `Still`.
    #[serde(default)]
    pub motion: Motion,
    /// Time at which the hand takes hold, s after all bodies of the scene exist. Default: 0.
    #[serde(default)]
    pub from: f64,
    /// Time at which the hand releases the body, s, later than `from`. Default: `None`, never.
    #[serde(default)]
    pub until: Option<f64>,
    /// Time in which the hand moves from where it took hold to its script, s. Default: 0.6.
    #[serde(default = "rise")]
    pub rise: f64,
    /// Stiffness of the hand's spring, N/m, above 0. Default: `None`, as stiff as the patch allows.
    #[serde(default)]
    pub stiffness: Option<f64>,
    /// Relaxation time of the hand's damper, s. Default: 0.
    #[serde(default)]
    pub relaxation: f64,
    /// The user that the hand belongs to. Default: `Here`.
    #[serde(default)]
    pub by: By,
}

fn rise() -> f64 {
    0.6
}

/// The user that a grab belongs to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
pub enum By {
    /// The user of this app.
    #[default]
    Here,
    /// The guest that `network: Host(guest: ..)` runs beside the host.
    Guest,
}

/// A part of a body's surface.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "Patch", deny_unknown_fields)]
pub enum PatchEntry {
    /// Around the vertex that is farthest in this direction, in the body's axes.
    Toward([f64; 3]),
    /// Around the vertex that is nearest to this point, m in the body's axes.
    Near([f64; 3]),
    /// Around the vertex with this index.
    Vertex(u32),
}

/// Motion of a hand, as an offset from where it is held, m.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(rename = "Motion", deny_unknown_fields)]
pub enum Motion {
    /// No motion.
    #[default]
    Still,
    /// Oscillation: `size * sin(2 pi hz t)` along each axis.
    Waves {
        /// Amplitude along each axis, m.
        size: [f64; 3],
        /// Frequency along each axis, Hz, 0 to 100.
        hz: [f64; 3],
    },
    /// Motion from point to point, with zero velocity at each point.
    Path {
        /// Points in the order of their times. The path begins at zero offset at time 0.
        points: Vec<PointEntry>,
        /// Whether the path repeats from its last point. Default: false, the hand stays at the last
        /// point.
        #[serde(default)]
        repeat: bool,
    },
}

/// A point of a path.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename = "Point", deny_unknown_fields)]
pub struct PointEntry {
    /// Time at which the hand reaches the point, s after it took hold, above 0.
    pub at: f64,
    /// Offset of the point, m.
    pub to: [f64; 3],
}

/// A session (feature `net`).
///
/// A `link` names an emulated network under the socket: `paper-1` to `paper-4`, `lan`, `wifi`,
/// `transatlantic` or `satellite`. Without a link, the real network is used unchanged.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Network", deny_unknown_fields)]
pub enum NetworkEntry {
    /// This app hosts. The invite is logged and available as
    /// [`SceneFilePlugin::invite`](super::SceneFilePlugin::invite).
    Host {
        /// Name of the user of this app. Default: `host`.
        #[serde(default = "host_name")]
        name: String,
        /// Address to listen on. Default: `None`, a free port on this machine.
        ///
        /// If other machines can reach the address, only guests with the invite are accepted.
        #[serde(default)]
        listen: Option<String>,
        /// An emulated network under all guests. Default: `None`.
        #[serde(default)]
        link: Option<String>,
        /// A complete guest beside the host, in the same process, on its own thread. Default:
        /// `None`.
        #[serde(default)]
        guest: Option<GuestEntry>,
    },
    /// This app joins. Bodies that arrive with a name of the scene appear at the places of the
    /// scene.
    Join {
        /// The invite that the host has printed.
        invite: String,
        /// Name of the user of this app. Default: `guest`.
        #[serde(default = "guest_name")]
        name: String,
        /// An emulated network. Default: `None`.
        #[serde(default)]
        link: Option<String>,
    },
    /// This app is one of several equal peers. All peers must have the same bodies.
    Peer {
        /// The invite of a peer that runs already. Default: `None`, this is the first peer.
        #[serde(default)]
        invite: Option<String>,
        /// Name of the user of this app. Default: `peer`.
        #[serde(default = "peer_name")]
        name: String,
        /// Address to listen on, as for a host. Default: `None`.
        #[serde(default)]
        listen: Option<String>,
        /// An emulated network. Default: `None`.
        #[serde(default)]
        link: Option<String>,
    },
}

fn host_name() -> String {
    "host".into()
}

fn guest_name() -> String {
    "guest".into()
}

fn peer_name() -> String {
    "peer".into()
}

/// A guest in the host's process: an app without a window behind an emulated link.
///
/// Its hands are the grabs with `by: Guest`. The host's window draws the guest's visual state
/// beside the host's bodies.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Guest", deny_unknown_fields)]
pub struct GuestEntry {
    /// Name of the guest. Default: `guest`.
    #[serde(default = "guest_name")]
    pub name: String,
    /// The emulated network between the guest and the host. Default: `None`.
    #[serde(default)]
    pub link: Option<String>,
    /// Seed that selects which packets the link loses. Default: 0.
    #[serde(default)]
    pub seed: u64,
    /// Offset at which the guest's bodies are drawn from the host's, m. Default: zero.
    #[serde(default)]
    pub beside: [f64; 3],
}

/// A haptic device (feature `haptics`). A scene file cannot open a real device; only a person can.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Device", deny_unknown_fields)]
pub enum DeviceEntry {
    /// A simulated device in a simulated hand.
    Virtual {
        /// The device that is simulated. Default: `Premium`.
        #[serde(default)]
        like: Like,
        /// How the hand holds the device. Default: `Firm`.
        #[serde(default)]
        grip: Grip,
        /// The patch at which the device begins: the center of its workspace lies there.
        on: TouchEntry,
        /// Motion of the hand in the device's workspace, m from its center. Default: `Still`.
        #[serde(default)]
        motion: Motion,
        /// Time at which the button goes down, s after all bodies exist, at least 0.2. Default:
        /// 0.5.
        ///
        /// A button counts only after the device loop has seen it open.
        #[serde(default = "press")]
        from: f64,
        /// Time at which the button goes up, s. Default: `None`, never.
        #[serde(default)]
        until: Option<f64>,
        /// Force in the hand per force in the world, N/N, 0 to 100. Default: 1.
        #[serde(default = "one")]
        force_scale: f64,
        /// Whether the device loop steps its own copy of the body. Default: false.
        #[serde(default)]
        modal: bool,
        /// Time for which the force waits for the next local model update before it fades, s, 0.01
        /// to 60. Default: `None`, the time of a real device.
        ///
        /// Slow machines can use a longer time, since no person holds a simulated device.
        #[serde(default)]
        patience: Option<f64>,
    },
    /// The pointer as a device. Its force is shown but not felt.
    Pointer {
        /// The patch at which the device begins.
        on: TouchEntry,
        /// Force in the hand per force in the world, N/N, 0 to 100. Default: 1.
        #[serde(default = "one")]
        force_scale: f64,
    },
}

fn press() -> f64 {
    0.5
}

/// The patch of a body at which a device's workspace lies.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Touch", deny_unknown_fields)]
pub struct TouchEntry {
    /// Name of the body.
    pub body: String,
    /// The part of its surface.
    pub patch: PatchEntry,
}

/// The devices that can be simulated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
pub enum Like {
    /// 3D Systems Touch: 3.3 N.
    Touch,
    /// PHANTOM Omni: 3.3 N.
    Omni,
    /// PHANTOM Premium 1.5: 8.5 N.
    #[default]
    Premium,
    /// Force Dimension omega.3: 12 N.
    Omega3,
}

/// How a simulated hand holds a simulated device.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
pub enum Grip {
    /// As firmly as a pen for writing.
    #[default]
    Firm,
    /// As lightly as a pen for pointing.
    Light,
    /// Barely.
    Loose,
}

/// A recording (feature `rerun`).
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename = "Recording", deny_unknown_fields)]
pub struct RecordingEntry {
    /// A file that ends with `.rrd`, below the working directory. Default: `None`.
    #[serde(default)]
    pub file: Option<String>,
    /// Whether to stream to the viewer on this machine, which is started if it is installed.
    /// Default: false.
    #[serde(default)]
    pub viewer: bool,
    /// Rate at which shapes are recorded, Hz, 0 to 1000. Default: 20.
    #[serde(default = "shapes_hz")]
    pub shapes_hz: f64,
    /// Rate at which metrics are recorded, Hz, 0 to 1e6. Default: `None`, every tick.
    #[serde(default)]
    pub metrics_hz: Option<f64>,
    /// Rate at which hands with their reactions and the forces of contacts are recorded, Hz, 0 to
    /// 1e6. Default: `None`, every tick.
    #[serde(default)]
    pub hands_hz: Option<f64>,
    /// Rate at which the energies of the modes and the spectrum are recorded, Hz, 0 to 1000.
    /// Default: 4.
    #[serde(default = "modes_hz")]
    pub modes_hz: f64,
    /// Quantity that the color of a surface shows. Default: `Displacement`.
    #[serde(default)]
    pub color: ColorEntry,
    /// Whether every period of a device loop is recorded (`RerunRecording::device_loops`). Default:
    /// false.
    #[serde(default)]
    pub device_loops: bool,
}

fn shapes_hz() -> f64 {
    20.0
}

fn modes_hz() -> f64 {
    4.0
}

/// Quantity that the color of a recorded surface shows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename = "Color")]
pub enum ColorEntry {
    /// Distance of each point from its rest position; the last color is at 0.3 of the body's size.
    #[default]
    Displacement,
    /// Von Mises stress in the skin; the last color is at 0.2 of Young's modulus.
    Stress,
}
