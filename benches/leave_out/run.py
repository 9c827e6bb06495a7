#!/usr/bin/env python3
"""What a scene costs, with what it does not need left out: eight typical scenes beside the engine alone, each compiled with its own features.

    python3 benches/leave_out/run.py [--only SCENE]... [--seconds S] [--one-engine] [--target-dir DIR] [-o FOLDER]

For each scene: the crates that are compiled, the size of its program (release, stripped), the systems in its schedules, and what a frame costs at rest and at
work. Writes leave-out.md and leave-out.csv. Most compile the engine with another set of features: with --one-engine the engine and all that is not
ours is compiled once, with the features that the whole project asks of it, and the programs of scenes with a window are up to that much larger than they need be.
"""

import argparse, csv, json, os, pathlib, shutil, subprocess, sys, tempfile

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benches"))
import stamp

SCENES = {
    "engine": ("the engine alone, with a camera", ["window"]),
    "bare": ("the engine alone, no picture", []),
    "solo": ("one body, pulled and looked at", ["window"]),
    "many": ("a thousand bodies of one model", ["window"]),
    "crowd": ("a thousand bodies of one model, no picture", []),
    "held": ("a thousand bodies of 30 modes, a hand at each, no picture", []),
    "host": ("a server of one body, no picture, one guest", ["net"]),
    "guest": ("a guest that sees and holds the host's body", ["window", "net"]),
    "haptics": ("one body that is felt, a device at 1 kHz", ["window", "haptics"]),
    "everything": ("all features: host, device, recording, bakes", ["window", "net", "haptics", "rerun", "panel", "bake"]),
}
# They are compiled with the crates of another scene, whose number and size are not the engine's
# own.
ALONE = ["engine", "bare"]
# Our own crates that ask something of the engine: with all of them chosen the engine's features
# are those of everything.
OURS = ["pliant_rerun", "pliant_panel", "pliant_net", "pliant_haptics", "pliant_bake"]


def cargo(*arguments):
    return subprocess.run(["cargo", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout


def crates(features):
    """Packages that a game with these features compiles, this project's own among them."""
    tree = cargo("tree", "-p", "pliant_examples", "--no-default-features", "--features", ",".join(features), "-e", "normal,build", "--prefix", "none", "-f", "{p}")
    return len({line.removesuffix(" (*)") for line in tree.splitlines() if line})


def build(features, one_engine, target):
    chosen, wanted = ["-p", "pliant_examples"], [f"pliant_examples/{feature}" for feature in features]
    # Without a renderer the engine is another one altogether.
    if one_engine and "window" in features:
        chosen += [argument for crate in OURS for argument in ("-p", crate)]
    cargo("build", "--release", *chosen, "--no-default-features", "--features", ",".join(wanted), "--example", "leave_out", "--target-dir", target)
    return pathlib.Path(target) / "release/examples/leave_out"


def called(features):
    return "-".join(features) or "none"


def stripped(program):
    with tempfile.TemporaryDirectory() as folder:
        copy = pathlib.Path(folder) / program.name
        shutil.copy(program, copy)
        subprocess.run(["strip", copy], check=True)
        return copy.stat().st_size


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", action="append", choices=SCENES)
    parser.add_argument("--seconds", type=float, default=5.0, help="measured at rest, and again at work")
    parser.add_argument("--one-engine", action="store_true")
    parser.add_argument("--target-dir", default=os.environ.get("CARGO_TARGET_DIR", str(ROOT / "target")))
    parser.add_argument("--headless-target-dir", help="for the scene without a picture; default: --target-dir")
    parser.add_argument("--programs", type=pathlib.Path, help="a folder with programs built before, each named by its features joined with '-', or none")
    parser.add_argument("-o", "--output", type=pathlib.Path, default=ROOT / "docs/report")
    args = parser.parse_args()
    rows, load, kept = [], [stamp.load()], tempfile.TemporaryDirectory()
    programs = {}
    for scene, (_, features) in SCENES.items():
        if args.only and scene not in args.only:
            continue
        if args.programs and not (args.programs / called(features)).is_file():
            continue
        if args.programs:
            programs[tuple(features)] = args.programs / called(features)
        elif tuple(features) not in programs:
            target = args.headless_target_dir if "window" not in features and args.headless_target_dir else args.target_dir
            # The next scene's program has the same name.
            programs[tuple(features)] = shutil.copy(build(features, args.one_engine, target), pathlib.Path(kept.name) / called(features))
    # Compiled first, measured then: nothing else of ours runs meanwhile.
    load.append(stamp.load())
    for scene, (what, features) in SCENES.items():
        if tuple(features) not in programs:
            continue
        program = pathlib.Path(programs[tuple(features)])
        told = json.loads(subprocess.run([program, "--scene", scene, "--seconds", str(args.seconds)], check=True, capture_output=True, text=True).stdout)
        row = {"scene": scene, "what": what, "features": " ".join(features), "crates": crates(features), "program_mb": stripped(program) / 1e6, "ours": scene not in ALONE,
               "systems": told["systems"] - told["engine_systems"], "engine_systems": told["engine_systems"]}
        for phase in ("rest", "work"):
            row |= {f"{phase}_{name}": value for name, value in told[phase].items()}
        rows.append(row)
    load.append(stamp.load())
    if not rows:
        sys.exit("nothing was measured")

    args.output.mkdir(parents=True, exist_ok=True)
    with open(args.output / "leave-out.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    version = stamp.locked("pliant")
    lines = ["# What a scene leaves out", "",
             f"{stamp.machine()}; Pliant {version}{stamp.commit()}, Bevy {stamp.locked('bevy')}. Load of the machine {load[1]:.1f} when measuring began, {load[2]:.1f} at its end; "
             f"{load[0]:.1f} before the builds. Remade by `python3 benches/leave_out/run.py{' --one-engine' if args.one_engine else ''}`.", "",
             "| scene | features | crates | program, MB | systems of ours (of the engine) | a frame at rest, ms (99 %) | at work, ms (99 %) | the steps of a tick at work, ms | processor a frame, rest / work, ms | bodies stepped, rest / work |",
             "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"]
    for r in rows:
        own = f"{r['crates']} | {r['program_mb']:.1f}" if r["ours"] else " | "
        lines.append(f"| {r['scene']}: {r['what']} | {r['features'].replace(' ', ', ')} | {own} | {r['systems']} ({r['engine_systems']}) | "
                     f"{r['rest_frame_ms']:.3f} ({r['rest_frame_ms_p99']:.2f}) | {r['work_frame_ms']:.3f} ({r['work_frame_ms_p99']:.2f}) | {r['work_step_ms']:.3f} | "
                     f"{r['rest_processor_ms']:.2f} / {r['work_processor_ms']:.2f} | {r['rest_awake']:.0f} / {r['work_awake']:.0f} |")
    for scene, (what, features) in SCENES.items():
        if not any(row["scene"] == scene for row in rows):
            lines.append(f"| {scene}: {what} | {', '.join(features)} | {crates(features)} | not measured in this run |  |  |  |  |  |  |")
    lines += ["",
              "*Crates*: packages in the dependency tree with the scene's features, our own among them. *Program*: optimized, stripped, with all of the engine that a windowed game has; the "
              "scene without a picture has the engine without a renderer." + (" The engine and all that is not ours were compiled once, with the features that the whole project asks of them; "
              "with the scene's own the programs may be smaller." if args.one_engine else ""), "",
              "*Frames* come sixty times a second and hold one step. There is no window and no graphics card: surfaces that a camera sees are written by the processor, and the engine's "
              "own frame is in the figures (the engine's systems, its visibility, its transforms). *Processor* counts all threads of the program: the session's, the device's, the recorder's. At rest nobody touches anything: "
              "no body is stepped, whatever the scene. A guest's body is stepped by the session, not by the system that is counted here. The other end of a session is a program of its own and not in these figures.", ""]
    text = "\n".join(lines)
    (args.output / "leave-out.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
