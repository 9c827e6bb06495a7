//! The program as a user runs it: meshing, baking and rejected input.

#![expect(clippy::unwrap_used, reason = "a failed test should panic")]

mod support;

use std::path::Path;

use support::{Folder, json, pliant, refused, succeeds, succeeds_with_a_word};

/// A closed octahedron of radius 1.
const OCTAHEDRON: &str = "v 1 0 0\nv -1 0 0\nv 0 1 0\nv 0 -1 0\nv 0 0 1\nv 0 0 -1\n\
    f 1 3 5\nf 3 2 5\nf 2 4 5\nf 4 1 5\nf 3 1 6\nf 2 3 6\nf 4 2 6\nf 1 4 6\n";

/// Returns the octahedron and one of half its size beside it.
fn two_octahedra() -> String {
    let mut text = OCTAHEDRON.to_owned();
    for line in OCTAHEDRON.lines() {
        let (kind, numbers) = line.split_at(1);
        let n: Vec<f64> = numbers.split_whitespace().map(|n| n.parse().unwrap()).collect();
        text += &match kind {
            "v" => format!("v {} {} {}\n", 0.5 * n[0] + 3.0, 0.5 * n[1], 0.5 * n[2]),
            _ => format!("f {} {} {}\n", n[0] + 6.0, n[1] + 6.0, n[2] + 6.0),
        };
    }
    text
}

#[test]
fn a_bar_is_meshed_baked_and_inspected() {
    let folder = Folder::new("bar");
    let (mesh, model) = (folder.file("bar.msh"), folder.file("bar.modal"));
    let told = succeeds(&["mesh", "bar", "--cells", "20,3,3", "--size", "1,0.15,0.15", "-o", &mesh]);
    assert!(told.contains("1080 tetrahedra"), "{told}");
    let bake = |rest: &[&str]| {
        let material = ["--young", "2e6", "--poisson", "0.3", "--density", "1100", "--rayleigh", "0.1,1e-4"];
        let shape = ["--element", "tet4", "--modes", "12", "--anchor", "x<0.001"];
        succeeds(&[&["bake", mesh.as_str()][..], &material, &shape, rest].concat())
    };
    let baked = json(&bake(&["-o", &model, "--json"]));
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

    // The same bake with another number of threads must give the same bits.
    let again = folder.file("again.modal");
    bake(&["--threads", "1", "-o", &again]);
    assert_eq!(std::fs::read(&model).unwrap(), std::fs::read(&again).unwrap());
}

#[test]
fn a_surface_is_filled_and_wears_a_skin() {
    let folder = Folder::new("surface");
    let surface = folder.write("octahedron.obj", OCTAHEDRON);
    let (mesh, model, matrices) = (folder.file("o.msh"), folder.file("o.modal"), folder.file("matrices"));
    // The lattice alone would round off 6 % of the volume: the mesh is fitted, without a warning.
    succeeds(&["mesh", &surface, "--tets", "1000", "-o", &mesh]);
    // A body is one piece: of two octahedra the larger one remains. The warning names both volumes.
    let two = folder.write("two.obj", &two_octahedra());
    let (_, word) = succeeds_with_a_word(&["mesh", &two, "--tets", "3000", "-o", &mesh]);
    assert!(word.lines().count() == 1 && word.contains("warning") && word.contains("1.500000e0"), "{word}");
    let baked = succeeds(&[
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
    assert_eq!(baked["material"], "neo-hookean", "the default");
    assert_eq!(baked["surface_vertices"], 6);
    assert_eq!(baked["rigid_modes"], 6);
    assert!((baked["mass_kg"].as_f64().unwrap() / (4000.0 / 3.0) - 1.0).abs() < 0.02, "of 4/3 m^3");
    assert!(Path::new(&matrices).join("K.mtx").exists() && Path::new(&matrices).join("M.mtx").exists());
}

/// The faces of a cube of 1 m around the origin. Each is a grid of 4 x 4 cells with its own
/// vertices.
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
    // 6 x 25 vertices. A cube of 4 x 4 x 4 cells has 125 - 27 vertices on its surface.
    let counts = serde_json::json!({
        "welded_vertices": 150 - 98, "dropped_triangles": 1, "turned_triangles": 1, "covered_holes": 1
    });
    assert_eq!(mended["repair"], counts);
    let words =
        "dirty.obj was mended: 52 vertices welded, 1 triangle dropped, 1 triangle turned, 1 hole covered";
    assert!(word.contains(words), "{word}");
    // The repaired cube must be the same as the clean cube.
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
    // Write the older version of Gmsh's format, from a file and from a shape. The nodes must be the
    // same to the bit.
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
    // The skin is read last, long after the matrices have been written.
    let failed = bake(&["--skin", &far]);
    assert!(String::from_utf8_lossy(&failed.stderr).contains("skin"), "{failed:?}");
    assert_eq!(folder.names(), ["a.msh", "far.obj"]);
    // The folder already holds a directory with the name of the second file. Nothing of the first
    // file may be left.
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
        (&[mesh, "--poisson", "0.49"], "a material other than linear"),
        (&[mesh, "--material", "rubber"], "expected neo-hookean, st-venant-kirchhoff or linear"),
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
fn drop_prints_every_step_and_refuses_what_it_cannot_do() {
    let jack = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/jack.modal");
    let said = succeeds(&["drop", jack, "--seconds", "0.5", "--onto", "sphere:0.2", "--json"]);
    let dropped: serde_json::Value = serde_json::from_str(&said).unwrap();
    let ticks = dropped["ticks"].as_array().unwrap();
    assert_eq!(ticks.len(), 31);
    for name in ["time", "kinetic", "elastic", "potential", "penetration", "step_us", "contacts"] {
        assert!(ticks[30][name].is_number(), "{name}");
    }
    for name in ["center", "velocity", "contact_force"] {
        assert_eq!(ticks[30][name].as_array().unwrap().len(), 3, "{name}");
    }
    assert!(succeeds(&["drop", jack, "--seconds", "0.1", "--tilt", "10"]).contains("contact sites"));
    let pip = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal");
    assert!(succeeds(&["drop", jack, "--seconds", "0.1", "--onto", pip]).contains("contact sites"));
    assert!(
        succeeds(&["bench", "pile", jack, "--seconds", "0.1", "--count", "2"]).contains("for each contact")
    );
    refused(&["bench", "pile", jack, "--count", "0"]);
    refused(&["drop", jack, "--onto", "cone"]);
    refused(&["drop", jack, "--friction", "-1"]);
    refused(&["drop", pip]);
}
