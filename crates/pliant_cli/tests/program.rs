//! The program as a user runs it.

#![expect(clippy::unwrap_used, reason = "a failed test should panic")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A folder of its own for each test, gone at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("pliant-cli-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn file(&self, name: &str) -> String {
        self.0.join(name).to_string_lossy().into_owned()
    }

    fn write(&self, name: &str, text: &str) -> String {
        std::fs::write(self.0.join(name), text).unwrap();
        self.file(name)
    }

    /// Names of the files in it.
    fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(&self.0)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// The program without a user's cache: every bake is a bake.
fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_pliant"));
    for name in ["HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"] {
        command.env_remove(name);
    }
    command
}

fn pliant(arguments: &[&str]) -> Output {
    program().args(arguments).output().unwrap()
}

fn succeeds(arguments: &[&str]) -> String {
    let (told, message) = succeeds_with_a_word(arguments);
    assert!(message.is_empty(), "no progress bar in a pipe: {message}");
    told
}

/// What it says on stdout and on stderr.
fn succeeds_with_a_word(arguments: &[&str]) -> (String, String) {
    let output = pliant(arguments);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {message}");
    (String::from_utf8(output.stdout).unwrap(), message)
}

/// Exit code 2, nothing on stdout, the message on stderr.
fn refused(arguments: &[&str]) -> String {
    let output = pliant(arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {message}");
    assert!(output.stdout.is_empty() && !message.trim().is_empty(), "{arguments:?}");
    message
}

fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).unwrap()
}

/// A closed octahedron of radius 1.
const OCTAHEDRON: &str = "v 1 0 0\nv -1 0 0\nv 0 1 0\nv 0 -1 0\nv 0 0 1\nv 0 0 -1\n\
    f 1 3 5\nf 3 2 5\nf 2 4 5\nf 4 1 5\nf 3 1 6\nf 2 3 6\nf 4 2 6\nf 1 4 6\n";

#[test]
fn a_bar_is_meshed_baked_and_inspected() {
    let folder = Folder::new("bar");
    let (mesh, model) = (folder.file("bar.msh"), folder.file("bar.modal"));
    let told = succeeds(&["mesh", "bar", "--cells", "20,3,3", "--size", "1,0.15,0.15", "-o", &mesh]);
    assert!(told.contains("1080 tetrahedra"), "{told}");
    let baked = json(&succeeds(&[
        "bake",
        &mesh,
        "--element",
        "tet4",
        "--modes",
        "12",
        "--young",
        "2e6",
        "--poisson",
        "0.3",
        "--density",
        "1100",
        "--rayleigh",
        "0.1,1e-4",
        "--anchor",
        "x<0.001",
        "-o",
        &model,
        "--json",
    ]));
    let inspected = json(&succeeds(&["inspect", &model, "--json"]));
    for field in [
        "tets",
        "nodes",
        "element",
        "modes",
        "rigid_modes",
        "frequencies_hz",
        "mass_kg",
        "surface_vertices",
        "bytes",
        "hash",
        "residual_max",
    ] {
        assert!(!inspected[field].is_null(), "{field}");
        assert_eq!(baked[field], inspected[field], "{field}");
    }
    for stage in ["mesh", "assemble", "factor", "modes", "total"] {
        assert!(baked["seconds"][stage].as_f64().unwrap() >= 0.0, "{stage}");
    }
    assert_eq!(inspected["tets"], 1080);
    assert_eq!(inspected["nodes"], 21 * 4 * 4);
    assert_eq!(inspected["element"], "tet4");
    assert_eq!(inspected["modes"], 12);
    assert_eq!(inspected["rigid_modes"], 0);
    assert_eq!(inspected["frequencies_hz"].as_array().unwrap().len(), 12);
    assert!((inspected["mass_kg"].as_f64().unwrap() - 1100.0 * 0.0225).abs() < 1e-9);
    assert_eq!(inspected["bytes"].as_u64().unwrap(), std::fs::metadata(&model).unwrap().len());
    assert!(inspected["residual_max"].as_f64().unwrap() < 1e-8);
    assert!(succeeds(&["inspect", &model]).contains("x<0.001"));
    assert_eq!(folder.names(), ["bar.modal", "bar.msh"]);

    // The same again with another number of threads: the same bits.
    let again = folder.file("again.modal");
    succeeds(&[
        "bake",
        &mesh,
        "--element",
        "tet4",
        "--modes",
        "12",
        "--young",
        "2e6",
        "--poisson",
        "0.3",
        "--density",
        "1100",
        "--rayleigh",
        "0.1,1e-4",
        "--anchor",
        "x<0.001",
        "--threads",
        "1",
        "-o",
        &again,
    ]);
    assert_eq!(std::fs::read(&model).unwrap(), std::fs::read(&again).unwrap());
}

#[test]
fn a_surface_is_filled_and_wears_a_skin() {
    let folder = Folder::new("surface");
    let surface = folder.write("octahedron.obj", OCTAHEDRON);
    let (mesh, model, matrices) = (folder.file("o.msh"), folder.file("o.modal"), folder.file("matrices"));
    // So few tetrahedra round its edges and corners: 6 % of the 4/3 m^3, which is told with both volumes.
    let (_, word) = succeeds_with_a_word(&["mesh", &surface, "--tets", "1000", "-o", &mesh]);
    assert!(word.lines().count() == 1 && word.contains("warning") && word.contains("1.333333e0"), "{word}");
    // 1.3 % with twice as many, and nothing is said.
    succeeds(&["mesh", &surface, "--tets", "2000", "-o", &mesh]);
    let (baked, _) = succeeds_with_a_word(&[
        "bake",
        &surface,
        "--tets",
        "1500",
        "--element",
        "tet4",
        "--modes",
        "6",
        "--skin",
        &surface,
        "--export-matrices",
        &matrices,
        "--damping-ratio",
        "0.1",
        "-o",
        &model,
        "--json",
    ]);
    let baked = json(&baked);
    assert_eq!(baked["surface_vertices"], 6);
    assert_eq!(baked["rigid_modes"], 6);
    // Volume 4/3 m^3; so few tetrahedra round its edges and corners.
    assert!((baked["mass_kg"].as_f64().unwrap() / (4000.0 / 3.0) - 1.0).abs() < 0.1);
    assert!(Path::new(&matrices).join("K.mtx").exists() && Path::new(&matrices).join("M.mtx").exists());
}

/// The faces of a cube of 1 m around the origin, each a grid of 4 x 4 cells with vertices of its own.
fn cube_faces() -> (String, Vec<String>) {
    let (mut vertices, mut faces) = (String::new(), Vec::new());
    for (face, (axis, side)) in (0..3).flat_map(|axis| [(axis, -0.5), (axis, 0.5)]).enumerate() {
        for n in 0..25 {
            let mut at = [side; 3];
            at[(axis + 1) % 3] = f64::from(n % 5) / 4.0 - 0.5;
            at[(axis + 2) % 3] = f64::from(n / 5) / 4.0 - 0.5;
            vertices += &format!("v {} {} {}\n", at[0], at[1], at[2]);
        }
        for cell in 0..16 {
            let a = 25 * face + cell / 4 * 5 + cell % 4 + 1;
            for [b, c] in [[a + 1, a + 6], [a + 6, a + 5]] {
                let [b, c] = if side > 0.0 { [b, c] } else { [c, b] };
                faces.push(format!("f {a} {b} {c}\n"));
            }
        }
    }
    (vertices, faces)
}

#[test]
fn a_dirty_surface_is_mended_and_a_sheet_is_refused() {
    let folder = Folder::new("dirty");
    let (vertices, faces) = cube_faces();
    let clean = folder.write("clean.obj", &(vertices.clone() + &faces.concat()));
    let sheet = folder.write("sheet.obj", &(vertices.clone() + &faces[..32].concat()));
    let mut dirty = faces;
    let corners: Vec<&str> = dirty[10].split_whitespace().collect();
    dirty[10] = format!("f {} {} {}\n", corners[1], corners[3], corners[2]);
    dirty.push(dirty[70].clone());
    dirty.remove(100);
    let dirty = folder.write("dirty.obj", &(vertices + &dirty.concat()));
    let model = folder.file("box.modal");
    let bake = |surface: &str| {
        let (told, word) = succeeds_with_a_word(&[
            "bake",
            surface,
            "--tets",
            "2000",
            "--element",
            "tet4",
            "--modes",
            "6",
            "-o",
            &model,
            "--json",
        ]);
        (json(&told), word)
    };
    let (sound, _) = bake(&clean);
    assert!(sound["repair"].is_null(), "{sound}");
    let (mended, word) = bake(&dirty);
    // 6 x 25 vertices, of which a cube of 4 x 4 x 4 cells has 125 - 27 on its surface.
    let counts = serde_json::json!({
        "welded_vertices": 150 - 98, "dropped_triangles": 1, "turned_triangles": 1, "covered_holes": 1
    });
    assert_eq!(mended["repair"], counts);
    let words =
        "dirty.obj was mended: 52 vertices welded, 1 triangle dropped, 1 triangle turned, 1 hole covered";
    assert!(word.contains(words), "{word}");
    // The same cube again.
    let mass = |told: &serde_json::Value| told["mass_kg"].as_f64().unwrap();
    assert!((mass(&mended) / mass(&sound) - 1.0).abs() < 1e-6, "{mended} {sound}");
    std::fs::remove_file(&model).unwrap();
    assert!(refused(&["bake", &sheet, "-o", &model]).contains("open surface"));
    assert!(!Path::new(&model).exists());
}

#[test]
fn tetrahedra_are_written_in_another_format() {
    let folder = Folder::new("convert");
    let (msh, veg, back) = (folder.file("a.msh"), folder.file("a.veg"), folder.file("b.msh"));
    succeeds(&["mesh", "bar", "--cells", "4,1,1", "--size", "0.4,0.1,0.1", "-o", &msh]);
    assert!(succeeds(&["mesh", &msh, "-o", &veg]).contains("24 tetrahedra"));
    succeeds(&["mesh", &veg, "-o", &back]);
    assert_eq!(std::fs::read(&msh).unwrap(), std::fs::read(&back).unwrap());
    assert!(refused(&["mesh", &msh, "--tets", "500", "-o", &veg]).contains("tetrahedra already"));
    // The older version of Gmsh's format, of a file and of a shape; the same nodes to the bit.
    let (old, again) = (folder.file("old.msh"), folder.file("again.msh"));
    let heads = |path: &str, version: &str| {
        std::fs::read_to_string(path).unwrap().starts_with(&format!("$MeshFormat\n{version} 0 8\n"))
    };
    succeeds(&["mesh", &msh, "--msh-version", "2.2", "-o", &old]);
    assert!(heads(&old, "2.2") && heads(&msh, "4.1"));
    succeeds(&["mesh", &old, "--msh-version", "4.1", "-o", &again]);
    assert_eq!(std::fs::read(&msh).unwrap(), std::fs::read(&again).unwrap());
    succeeds(&["mesh", "cube", "--cells", "1", "--size", "1", "--msh-version", "2.2", "-o", &old]);
    assert!(heads(&old, "2.2"));
    assert!(refused(&["mesh", &msh, "--msh-version", "2.2", "-o", &veg]).contains("ends in .msh"));
    assert!(refused(&["mesh", &msh, "--msh-version", "3", "-o", &old]).contains("2.2 or 4.1"));
}

#[test]
fn matrices_are_left_by_a_bake_that_succeeded_only() {
    let folder = Folder::new("matrices");
    let (mesh, model, matrices) = (folder.file("a.msh"), folder.file("a.modal"), folder.file("matrices"));
    succeeds(&["mesh", "bar", "--cells", "4,1,1", "--size", "0.4,0.1,0.1", "-o", &mesh]);
    let far = folder.write("far.obj", &OCTAHEDRON.replace("v 1 0 0", "v 50 0 0"));
    let bake = |more: &[&str]| {
        let all =
            [&["bake", &mesh, "--modes", "3", "-o", &model, "--export-matrices", &matrices], more].concat();
        pliant(&all)
    };
    // The skin is looked at last, long after the matrices are there.
    let failed = bake(&["--skin", &far]);
    assert!(String::from_utf8_lossy(&failed.stderr).contains("skin"), "{failed:?}");
    assert_eq!(folder.names(), ["a.msh", "far.obj"]);
    // A folder that holds something else under the name of the second file: nothing is left of the first.
    std::fs::create_dir_all(Path::new(&matrices).join("M.mtx")).unwrap();
    assert_eq!(bake(&[]).status.code(), Some(2));
    assert!(!Path::new(&matrices).join("K.mtx").exists() && !Path::new(&model).exists());
    std::fs::remove_dir_all(&matrices).unwrap();
    folder.write("matrices", "a file");
    assert_eq!(bake(&[]).status.code(), Some(2));
    std::fs::remove_file(&matrices).unwrap();
    assert!(bake(&[]).status.success());
    assert!(Path::new(&matrices).join("M.mtx").is_file());
}

#[test]
fn a_name_cannot_write_to_the_terminal() {
    let folder = Folder::new("plain");
    let (mesh, model) = (folder.file("a\u{1b}[31m.msh"), folder.file("a.modal"));
    let plain = folder.file("a.msh");
    succeeds(&["mesh", "bar", "--cells", "4,1,1", "--size", "0.4,0.1,0.1", "-o", &plain]);
    std::fs::rename(&plain, &mesh).unwrap();
    succeeds(&["bake", &mesh, "--modes", "3", "-o", &model]);
    let table = succeeds(&["inspect", &model]);
    assert!(table.contains("a\\u{1b}[31m") && !table.contains('\u{1b}'), "{table:?}");
}

#[test]
fn simple_shapes_are_meshed() {
    let folder = Folder::new("shapes");
    let path = folder.file("x.msh");
    assert!(
        succeeds(&["mesh", "cube", "--cells", "3", "--size", "2", "-o", &path]).contains("162 tetrahedra")
    );
    assert!(
        succeeds(&["mesh", "sphere", "--cells", "4", "--radius", "0.5", "-o", &path])
            .contains("384 tetrahedra")
    );
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.ron");
    assert!(Path::new(scene).is_file(), "{scene} comes with the project");
    succeeds(&["mesh", scene, "--tets", "3000", "-o", &path]);
}

#[test]
fn bad_input_is_refused_and_leaves_no_file() {
    let folder = Folder::new("bad");
    let mesh = folder.file("bar.msh");
    succeeds(&["mesh", "bar", "--cells", "6,2,2", "--size", "0.6,0.2,0.2", "-o", &mesh]);
    let mesh = mesh.as_str();
    let open = folder.write("open.obj", &OCTAHEDRON.replace("f 1 4 6\n", ""));
    let crossing = folder.write("crossing.obj", &OCTAHEDRON.replace("v 0 0 1\n", "v 3 3 -0.5\n"));
    let truncated = folder.write("cut.obj", "v 1 0 0\nv 0 1");
    let foreign = folder.write("foreign.msh", "{\"not\": \"a mesh\"}");
    let text = folder.write("text.txt", "hello");
    let flat = folder.write(
        "flat.msh",
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 1 1 0\n$EndNodes\n\
         $Elements\n1\n1 4 2 0 1 1 2 3 4\n$EndElements\n",
    );
    let before = folder.names();
    let out = folder.file("out.modal");
    let missing = folder.file("missing.obj");
    let cases: &[(&[&str], &str)] = &[
        (&[&missing], "missing.obj"),
        (&[&truncated], "cut.obj"),
        (&[&foreign], "foreign.msh"),
        (&[&text], "extension"),
        (&[&open], "open"),
        (&[&crossing], "bounds no body"),
        (&[&flat], "volume"),
        (&[mesh, "--anchor", "x<-1"], "holds nothing"),
        (&[mesh, "--anchor", "x<9"], "hold all"),
        (&[mesh, "--anchor", "x=1"], "x<0.01"),
        (&[mesh, "--anchor", "w<1"], "x<0.01"),
        (&[mesh, "--young", "0"], "Young"),
        (&[mesh, "--young", "NaN"], "Young"),
        (&[mesh, "--young", "-5"], "Young"),
        (&[mesh, "--young", "soft"], "invalid"),
        (&[mesh, "--poisson", "0.5"], "Poisson"),
        (&[mesh, "--poisson", "-1"], "Poisson"),
        (&[mesh, "--density", "0"], "density"),
        (&[mesh, "--young", "1e300"], "1e-3 to 1e15 Pa"),
        (&[mesh, "--density", "1e-300"], "1e-6 to 1e7 kg/m^3"),
        (&[mesh, "--damping-ratio", "1e9"], "0 to 1000"),
        (&[mesh, "--rayleigh", "0,1e200"], "beta"),
        (&[mesh, "--rayleigh", "1"], "two numbers"),
        (&[mesh, "--rayleigh", "-1,0"], "alpha"),
        (&[mesh, "--damping-ratio", "inf"], "damping ratio"),
        (&[mesh, "--rayleigh", "1,0", "--damping-ratio", "0.1"], "cannot be used"),
        (&[mesh, "--element", "hex8"], "tet4 or tet10"),
        (&[mesh, "--element", "tet4", "--modes", "190"], "modes"),
        (&[mesh, "--modes", "0"], "modes"),
        (&[mesh, "--modes", "-3"], "modes"),
        (&[mesh, "--modes", "100000"], "modes"),
        (&[mesh, "--tets", "500"], "tetrahedra already"),
        (&[mesh, "--threads", "0"], "threads"),
        (&[mesh, "--skin", &missing], "missing.obj"),
        (&[&open, "--tets", "0"], "open"),
    ];
    for (arguments, expected) in cases {
        let mut all = vec!["bake"];
        all.extend(*arguments);
        all.extend(["-o", &out]);
        let message = refused(&all);
        assert!(message.contains(expected), "{arguments:?}: expected `{expected}` in: {message}");
        assert_eq!(folder.names(), before, "{arguments:?}");
    }
    let nowhere = folder.file("no/such/folder.modal");
    assert!(refused(&["bake", mesh, "-o", &nowhere]).contains("folder"));
    for arguments in [
        &["mesh", "bar", "--cells", "0,1,1", "--size", "1,1,1", "-o", &out] as &[&str],
        &["mesh", "bar", "--cells", "2,2", "--size", "1,1,1", "-o", &out],
        &["mesh", "bar", "--cells", "2,2,2", "--size", "1,-1,1", "-o", &out],
        &["mesh", "cube", "--cells", "2", "--size", "nan", "-o", &out],
        &["mesh", "sphere", "--cells", "2", "--radius", "0", "-o", &out],
        &["mesh", &open, "--tets", "1000", "-o", &out],
        &["mesh", "-o", &out],
        &["mesh", &open],
        &["bake", "-o", &out],
        &["frobnicate"],
    ] {
        refused(arguments);
        assert_eq!(folder.names(), before, "{arguments:?}");
    }
}

#[test]
fn models_that_are_cut_or_foreign_are_refused() {
    let folder = Folder::new("models");
    let (mesh, model) = (folder.file("bar.msh"), folder.file("bar.modal"));
    succeeds(&["mesh", "bar", "--cells", "4,1,1", "--size", "0.4,0.1,0.1", "-o", &mesh]);
    succeeds(&["bake", &mesh, "--modes", "3", "-o", &model]);
    let bytes = std::fs::read(&model).unwrap();
    let cut = folder.file("cut.modal");
    std::fs::write(&cut, &bytes[..bytes.len() - 10]).unwrap();
    assert!(refused(&["inspect", &cut]).contains("cut.modal"));
    let mut altered = bytes.clone();
    let last = altered.len() - 1;
    altered[last] ^= 1;
    std::fs::write(&cut, altered).unwrap();
    assert!(refused(&["inspect", &cut, "--json"]).contains("altered"));
    assert!(refused(&["inspect", &mesh]).contains("not a .modal file"));
    assert!(refused(&["inspect", &folder.file("none.modal")]).contains("none.modal"));
}

#[test]
fn a_stream_is_measured_and_the_same_seed_gives_the_same_figures() {
    let folder = Folder::new("stream");
    let (mesh, model) = (folder.file("bar.msh"), folder.file("bar.modal"));
    succeeds(&["mesh", "bar", "--cells", "8,2,2", "--size", "1,0.2,0.2", "-o", &mesh]);
    succeeds(&["bake", &mesh, "--element", "tet4", "--modes", "12", "--anchor", "x<0.01", "-o", &model]);
    let run = |recovery: &str, seed: &str| {
        let text = succeeds(&[
            "stream",
            "--model",
            &model,
            "--network",
            "paper-1",
            "--recovery",
            recovery,
            "--seconds",
            "10",
            "--seed",
            seed,
            "--json",
        ]);
        json(&text)
    };
    let number = |told: &serde_json::Value, key: &str| told[key].as_f64().unwrap();
    let default = run("default", "7");
    assert_eq!(default["hash"], run("default", "7")["hash"]);
    assert_ne!(default["hash"], run("default", "8")["hash"]);
    // 10 s at 40 Hz; 9 % of the datagrams are lost on average, 36 of 400: five standard deviations (5.7) either way.
    assert!((390.0..=410.0).contains(&number(&default, "ticks")));
    assert!((8.0..=65.0).contains(&number(&default, "lost")));
    // The bars of the streaming method on this network.
    assert!(number(&default, "rms_percent") < 0.2, "{default}");
    assert!(number(&default, "max_percent") < 3.0, "{default}");
    assert!(number(&default, "kbit_s") < 100.0, "{default}");
    // Without repair an acceleration stream never forgets an error.
    assert!(number(&run("none", "7"), "rms_percent") > 100.0 * number(&default, "rms_percent"));

    let keys: Vec<&String> = default.as_object().unwrap().keys().collect();
    let promised = "ticks lost recovered rms_percent max_percent end_percent force_rms_percent force_ringing \
        hand_to_force_ms shown_delay_ms recover_ms bytes_per_frame kbit_s cpu_us_per_tick hash";
    let mut promised: Vec<&str> = promised.split_whitespace().collect();
    promised.sort_unstable();
    assert_eq!(keys, promised);

    // A relaxing material, the paper's resending, equal peers.
    let more = |words: &str| {
        let mut all = vec!["stream", "--model", &model, "--seconds", "18", "--json"];
        all.extend(words.split_whitespace());
        json(&succeeds(&all))
    };
    assert!(number(&more("--relax 0.5:0.4"), "rms_percent") < 0.5);
    let paper = more("--loss random:22@135 --resend-after 50 --recovery paper-hold");
    assert_eq!((number(&paper, "lost"), number(&paper, "ticks") > 300.0), (22.0, true), "{paper}");
    for repair in ["rollback", "compensate"] {
        let told = more(&format!("--topology p2p --recovery {repair} --network wifi"));
        assert!(number(&told, "ticks") > 300.0 && number(&told, "hand_to_force_ms") <= 25.0, "{told}");
    }

    let table = succeeds(&["stream", "--model", &model, "--loss", "burst:12@140", "--seconds", "10"]);
    for name in ["default", "none", "paper", "force-driven"] {
        assert!(table.lines().any(|line| line.starts_with(name)), "{name} in {table}");
    }
    for bad in [
        vec!["--network", "nowhere"],
        vec!["--recovery", "prayer"],
        vec!["--loss", "often"],
        vec!["--rate", "0"],
        vec!["--seconds", "nan"],
        vec!["--relax", "1.0:0.4"],
        vec!["--relax", "much"],
    ] {
        refused(&[&["stream", "--model", &model][..], &bad].concat());
    }
    refused(&["stream", "--model", &mesh]);
}

#[test]
fn a_body_is_timed_against_the_memory() {
    let folder = Folder::new("bench");
    let (mesh, model) = (folder.file("bar.msh"), folder.file("bar.modal"));
    succeeds(&["mesh", "bar", "--cells", "8,2,2", "--size", "1,0.2,0.2", "-o", &mesh]);
    succeeds(&["bake", &mesh, "--element", "tet4", "--modes", "12", "--anchor", "x<0.01", "-o", &model]);
    let told = json(&succeeds(&["bench", "step", &model, "--seconds", "0.05", "--json"]));
    for times in ["step_us", "reconstruct_us"] {
        let at = |part: &str| told[times][part].as_f64().unwrap();
        assert!(0.0 < at("p50") && at("p50") <= at("p99") && at("p99") <= at("p999"), "{told}");
    }
    // Blocks of 16 vertices, (12 modes x 6 rows + 3 of rest) x 16 x 4 bytes each, and 12 bytes written a vertex.
    let vertices = told["surface_vertices"].as_u64().unwrap();
    assert_eq!(
        told["bytes"].as_u64().unwrap(),
        vertices.div_ceil(16) * (12 * 6 + 3) * 16 * 4 + 12 * vertices
    );
    assert!(told["bandwidth_limit_gb_s"].as_f64().unwrap() > 0.0);
    refused(&["bench", "step", &mesh]);
    refused(&["bench", "step", &model, "--seconds", "-1"]);
}

#[test]
fn an_unchanged_bake_comes_from_the_cache() {
    let folder = Folder::new("cache");
    let mesh = folder.file("bar.msh");
    succeeds(&["mesh", "bar", "--cells", "4,2,2", "--size", "0.4,0.2,0.2", "-o", &mesh]);
    let cache = folder.file("cache");
    let bake = |output: &str, more: &[&str]| {
        let mut arguments =
            vec!["bake", &mesh, "--modes", "6", "--anchor", "x<0.001", "-o", output, "--json"];
        arguments.extend(more);
        json(&succeeds(&arguments))
    };
    let [a, b, c] = ["a.modal", "b.modal", "c.modal"].map(|name| folder.file(name));
    let first = bake(&a, &["--cache", &cache]);
    assert_eq!(first["cached"], false);
    let second = bake(&b, &["--cache", &cache]);
    assert_eq!(second["cached"], true);
    assert_eq!(second["hash"], first["hash"]);
    assert_eq!(std::fs::read(&a).unwrap(), std::fs::read(&b).unwrap());
    assert_eq!(bake(&c, &["--cache", &cache, "--young", "2e5"])["cached"], false);
    assert_eq!(bake(&c, &["--no-cache"])["cached"], false);
    let told = succeeds(&["bake", &mesh, "--modes", "6", "--anchor", "x<0.001", "-o", &b, "--cache", &cache]);
    assert!(told.contains("read from the cache"), "{told}");
    assert!(refused(&["bake", &mesh, "-o", &b, "--cache", &cache, "--no-cache"]).contains("--no-cache"));

    // The user's own cache; one that cannot be is a word on stderr, not a failure.
    let with_home = |home: &str| {
        let output = program()
            .env("XDG_CACHE_HOME", home)
            .args(["bake", &mesh, "--modes", "6", "-o", &c, "--json"])
            .output()
            .unwrap();
        assert!(output.status.success());
        let cached = json(std::str::from_utf8(&output.stdout).unwrap())["cached"].as_bool().unwrap();
        (cached, String::from_utf8(output.stderr).unwrap())
    };
    if cfg!(all(unix, not(target_os = "macos"))) {
        let home = folder.file("home");
        assert_eq!(with_home(&home), (false, String::new()));
        assert_eq!(with_home(&home), (true, String::new()));
        let (cached, word) = with_home(&mesh);
        assert!(!cached && word.contains("not kept"), "{word}");
    }
}

#[test]
fn the_short_form_of_the_stability_matrix_keeps_its_bounds() {
    let told = json(&succeeds(&["stability", "--short", "--json"]));
    let cases = told["cases"].as_array().unwrap();
    assert!(cases.len() >= 30, "{}", cases.len());
    let mut with_the_papers_scheme = 0;
    for case in cases {
        assert!(case["passed"] == true || case["known_limit"].is_string(), "{case}");
        assert!(case["margin"].as_f64().unwrap() >= 1.0 || case["known_limit"].is_string(), "{case}");
        assert!(case["bound"].as_str().unwrap().contains("<=") || case["known_limit"].is_string(), "{case}");
        with_the_papers_scheme += usize::from(case["plain"].is_string());
    }
    assert!(with_the_papers_scheme >= 5, "{with_the_papers_scheme}");
    let message = refused(&["stability", "--only", "no such case"]);
    assert!(message.contains("--only"), "{message}");
}

#[test]
fn a_report_writes_its_words_numbers_and_pictures() {
    let folder = Folder::new("report");
    let told =
        json(&succeeds(&["report", "--quick", "--only", "steps", "-o", &folder.file("out"), "--json"]));
    assert_eq!(told["parts"][0]["name"], "steps");
    let read = |name: &str| std::fs::read(folder.0.join("out").join(name)).unwrap();
    for file in told["parts"][0]["files"].as_array().unwrap() {
        assert!(!read(file.as_str().unwrap()).is_empty(), "{file}");
    }
    assert!(read("c-steps-free.png").starts_with(b"\x89PNG"));
    let text = String::from_utf8(read("report.md")).unwrap();
    assert!(text.contains("c-steps-held.svg") && text.contains("The reference itself is off by"), "{text}");
    // The exact step needs no small steps: at 60 Hz a struck bar is off by rounding, Newmark by more than a percent.
    let csv = String::from_utf8(read("c-steps-free.csv")).unwrap();
    let error = |line: &str| {
        let row = csv.lines().find(|row| row.starts_with(&format!("\"{line}"))).unwrap();
        row.split(',').nth(2).unwrap().parse::<f64>().unwrap()
    };
    assert!(error("exact") < 1e-10 && error("Newmark") > 0.01, "{csv}");
    let message = refused(&["report", "--only", "nothing", "-o", &folder.file("out")]);
    assert!(message.contains("--only"), "{message}");
}
