//! The fake vendor libraries of `tests/fake`, built by the test.
#![allow(dead_code, unused_macros, reason = "every test uses its own part of it")]

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use libloading::Library;
use pliant_haptics::{ForceDimensionConfig, OpenHapticsConfig};

/// Builds `tests/fake/<source>.c`. Every test has its own library and so its own state.
pub fn fake(source: &str, test: &str, options: &[&str]) -> PathBuf {
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fake").join(source).with_extension("c");
    let to = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("lib{source}_{test}.so"));
    // The file is renamed into place, because another run of these tests may have the existing one
    // open.
    let built = to.with_extension(std::process::id().to_string());
    let is_there = |compiler: &&str| Command::new(compiler).arg("--version").output().is_ok();
    let compiler = ["cc", "gcc", "clang"].into_iter().find(is_there);
    let compiler = compiler.expect("a C compiler (cc, gcc or clang), which the workspace needs to build");
    let status = Command::new(compiler)
        .args(["-shared", "-fPIC", "-O1", "-Wall", "-o"])
        .args([&built, &from])
        .args(options)
        .arg("-lm")
        .status()
        .unwrap();
    assert!(status.success(), "{compiler} does not build {from:?}: are the C library's headers there?");
    std::fs::rename(built, &to).unwrap();
    to
}

/// Calls `symbol` of the same library instance that the device has loaded.
macro_rules! call {
    ($library:expr, $symbol:literal, fn($($type:ty),*) $(-> $ret:ty)?, $($arg:expr),*) => {{
        // SAFETY: the signature is that of tests/fake.
        unsafe {
            let f = $library.get::<unsafe extern "C" fn($($type),*) $(-> $ret)?>($symbol).unwrap();
            f($($arg),*)
        }
    }};
}

pub fn open_fake(path: &Path) -> Library {
    // SAFETY: the test's own library has no initializers.
    unsafe { Library::new(path).unwrap() }
}

pub fn place(library: &Library, p: [f64; 3], vx: f64) {
    call!(library, "fake_place", fn(f64, f64, f64, f64), p[0], p[1], p[2], vx);
}

pub fn force(library: &Library) -> [f64; 3] {
    let mut out = [0.0f64; 6];
    call!(library, "fake_force", fn(*mut f64), out.as_mut_ptr());
    [out[0], out[1], out[2]]
}

pub fn hd(path: &Path) -> OpenHapticsConfig {
    OpenHapticsConfig { library: Some(path.to_path_buf()), ..OpenHapticsConfig::default() }
}

pub fn dhd(path: &Path) -> ForceDimensionConfig {
    ForceDimensionConfig { library: Some(path.to_path_buf()), ..ForceDimensionConfig::default() }
}

/// These tests run one at a time, because the count of open devices is global to the process, like
/// the scheduler of the real library.
pub static ONE_HD: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// Returns what the motors of the fake exert now, N.
pub fn motor(library: &Library) -> f64 {
    let mut out = [0.0f64; 6];
    call!(library, "fake_motor", fn(*mut f64), out.as_mut_ptr());
    out[..3].iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Returns the largest rise of the motors' force from one call to the next since the last look, N.
pub fn rise(library: &Library) -> f64 {
    call!(library, "fake_rise", fn() -> f64,)
}
