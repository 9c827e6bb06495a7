#!/usr/bin/env python3
"""Error against run time, Pliant and its peers: a bar that hangs from a wall under its own weight.

    python3 benches/peers/hang.py [--quick | --fine] [--pliant PATH] [-o docs/report/hang]

A bar of 1 m x 0.05 m x 0.05 m (E 2.9e6 Pa, nu 0.3, 1000 kg/m^3) is fixed at one end and hangs under half the gravity of the earth, which
bends its end down by two thirds of its length. The reference is none of the programs: it is the heavy elastica, E I t'' = w (L - s) cos t,
solved here. Each program gets meshes of several sizes, comes to rest in its own way, and is told its error (how far its end is from the
elastica's, in percent of the length) beside the time of a step and of a second of motion, one thread each. What is not installed is left
out and named. Writes OUT.md, OUT.csv and OUT.svg.
"""

import argparse, csv, json, os, pathlib, platform, subprocess, sys, tempfile, time

# One thread for each program, and a word where numpy or scipy is missing: before numpy is imported.
from run import ROOT, version

import numpy as np
from scipy.integrate import solve_bvp

LENGTH, SIDE = 1.0, 0.05
YOUNG, POISSON, DENSITY, GRAVITY = 2.9e6, 0.3, 1000.0, 0.5 * 9.81
# Timed steps of the body at rest.
TIMED = 200


def elastica():
    """How far the end moves along the bar and down, m."""
    ratio = DENSITY * SIDE**2 * GRAVITY / (YOUNG * SIDE**4 / 12)
    slope = lambda s, y: np.vstack([y[1], ratio * (LENGTH - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])
    ends = lambda a, b: np.array([a[0], b[1], a[2], a[3]])
    s = np.linspace(0, LENGTH, 400)
    solved = solve_bvp(slope, ends, s, np.vstack([0 * s, 0 * s, s, 0 * s]), tol=1e-10, max_nodes=100_000)
    if not solved.success:
        raise RuntimeError(solved.message)
    return np.array([solved.y[2, -1] - LENGTH, solved.y[3, -1]])


def settle(step, where, second, seconds=40.0):
    """Steps until the end stays where it is. Returns where that is and the median time of a step, us. `second`: steps of a second."""
    last = where()
    for _ in range(int(seconds)):
        for _ in range(second):
            step()
        now = where()
        if np.linalg.norm(now - last) < 1e-5 * LENGTH:
            break
        last = now
    else:
        raise RuntimeError(f"not at rest after {seconds:.0f} s: {now} after {last}")
    if not np.isfinite(now).all():
        raise RuntimeError("blew up")
    samples = []
    for _ in range(TIMED):
        began = time.perf_counter()
        step()
        samples.append((time.perf_counter() - began) * 1e6)
    return now, float(np.median(samples))


def grid(cells):
    """Points and tetrahedra, six to a cell. The bar's axis is x, its end's center at y = z = 0."""
    counts = np.array(cells) + 1
    at = [np.linspace(0, LENGTH, counts[0]), *(np.linspace(-SIDE / 2, SIDE / 2, n) for n in counts[1:])]
    points = np.stack(np.meshgrid(*at, indexing="ij"), axis=-1).reshape(-1, 3)
    number = lambda i, j, k: (i * counts[1] + j) * counts[2] + k
    tets = []
    for i in range(cells[0]):
        for j in range(cells[1]):
            for k in range(cells[2]):
                corner = lambda bits: number(i + (bits & 1), j + (bits >> 1 & 1), k + (bits >> 2 & 1))
                for a, b in ((1, 3), (3, 2), (2, 6), (6, 4), (4, 5), (5, 1)):
                    tet = [corner(0), corner(a), corner(b), corner(7)]
                    p = points[tet]
                    tets.append(tet if np.linalg.det(p[1:] - p[0]) > 0 else [tet[1], tet[0], *tet[2:]])
    return points, np.array(tets)


def end_of(points):
    return np.flatnonzero(points[:, 0] > LENGTH - 1e-9)


def pliant(command, folder, cells, coordinates, elasticity):
    run = lambda *words: subprocess.run([*command, *map(str, words)], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    mesh, model, surface = folder / "bar.vtk", folder / "bar.modal", folder / "bar.ply"
    run("mesh", "bar", "--cells", ",".join(map(str, cells)), "--size", f"{LENGTH},{SIDE},{SIDE}", "-o", mesh)
    material = ["--material", "neo-hookean"] if elasticity == "reduced" else []
    run("bake", mesh, "--modes", coordinates, "--young", YOUNG, "--poisson", POISSON, "--density", DENSITY, "--anchor", "x<1e-9",
        *material, "--no-cache", "-o", model)
    # The hand holds the wall's side of the bar, where nothing moves: a step of this costs what one
    # with a hand costs.
    told = json.loads(run("pull", model, "--at", f"0,{SIDE / 2},{SIDE / 2}", "--radius", 0.02, "--by", "0,0,0", "--gravity", f"0,{-GRAVITY},0",
                          "--elasticity", elasticity, "--surface", surface, "--json"))
    if not told["at_rest"]:
        raise RuntimeError("not at rest")
    straight = folder / "rest.ply"
    run("pull", model, "--at", f"0,{SIDE / 2},{SIDE / 2}", "--radius", 0.02, "--by", "0,0,0", "--elasticity", "linear", "--surface", straight, "--json")
    rest = read_ply(straight)
    moved = read_ply(surface)
    end = end_of(rest)
    went = (moved[end] - rest[end]).mean(axis=0)
    return went[:2], told["step_us"]["p50"], 1 / 60


def read_ply(path):
    data = path.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    count = int(next(line for line in head.decode().splitlines() if line.startswith("element vertex")).split()[-1])
    if b"format ascii" in head:
        return np.array([[float(x) for x in line.split()[:3]] for line in body.decode().splitlines()[:count]])
    kind = "<f8" if b"property double x" in head else "<f4"
    return np.frombuffer(body, kind, 3 * count).reshape(-1, 3).astype(float)


def rapier(cells, solver, model):
    import rapier3d

    points, tets = grid(cells)
    pinned = np.flatnonzero(points[:, 0] < 1e-9).tolist()
    step = 1 / 240
    world = rapier3d.PhysicsWorld(gravity=(0, -GRAVITY, 0))
    world.integration_parameters.dt = step
    world.physics_pipeline.set_num_threads(1)
    builder = (
        rapier3d.SoftBodyBuilder(points)
        .cells(tets.tolist())
        .material(rapier3d.SoftBodyMaterial(young_modulus=YOUNG, poisson_ratio=POISSON))
        .cell_model(getattr(rapier3d.SoftBodyCellModel, model))
        .solver(getattr(rapier3d.SoftBodySolver, solver))
        .mass(DENSITY * LENGTH * SIDE**2)
        .pinned_particles(pinned)
        .linear_damping(5.0)
        .can_sleep(False)
        .no_surface_collider()
    )
    body = world.soft_bodies.insert(builder, world.rigid_bodies, world.colliders)
    end = end_of(points)
    where = lambda: (np.asarray(world.soft_bodies[body].particle_positions)[end] - points[end]).mean(axis=0)
    went, us = settle(world.step, where, 240)
    return went[:2], us, step


def mujoco_flex(cells):
    """Its implicit integrator. Steps are halved until it is stable."""
    import mujoco

    counts = [n + 1 for n in cells]
    spacing = " ".join(str(s / n) for s, n in zip((LENGTH, SIDE, SIDE), cells))
    # Vertices of a grid are numbered with z fastest: those of the wall come first.
    wall = " ".join(map(str, range(counts[1] * counts[2])))
    for per_second in (120, 240, 500, 1000, 2000, 4000, 8000, 16000):
        xml = f"""<mujoco><option timestep="{1 / per_second}" gravity="0 {-GRAVITY} 0" integrator="discrete"/><size memory="400M"/><worldbody>
          <flexcomp name="bar" type="grid" count="{' '.join(map(str, counts))}" spacing="{spacing}" pos="{LENGTH / 2} 0 0"
                    mass="{DENSITY * LENGTH * SIDE**2}" dim="3" radius="0.001">
          <contact selfcollide="none" contype="0" conaffinity="0"/><pin id="{wall}"/>
          <elasticity young="{YOUNG}" poisson="{POISSON}" damping="0.1"/></flexcomp></worldbody></mujoco>"""
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        start = data.flexvert_xpos.copy()
        end, held = end_of(start), np.flatnonzero(start[:, 0] < 1e-9)
        # Not the one about its nearly singular matrix, which it tells at every step and survives.
        bad = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{kind}")) for kind in ("QPOS", "QVEL", "QACC")]
        unstable = lambda: any(data.warning[kind].number for kind in bad)
        for _ in range(per_second // 2):
            mujoco.mj_step(model, data)
        if unstable():
            continue
        went, us = settle(lambda: mujoco.mj_step(model, data), lambda: (data.flexvert_xpos[end] - start[end]).mean(axis=0), per_second)
        if unstable():
            continue
        if np.abs(data.flexvert_xpos[held] - start[held]).max() > 1e-6:
            raise RuntimeError("the wall's vertices moved")
        return went[:2], us, 1 / per_second
    raise RuntimeError("unstable with steps of 1/16,000 s")


def bullet(cells, folder):
    import pybullet

    points, tets = grid(cells)
    path = folder / "bullet.vtk"
    lines = ["# vtk DataFile Version 2.0", "bar", "ASCII", "DATASET UNSTRUCTURED_GRID", f"POINTS {len(points)} double"]
    lines += [" ".join(map(repr, map(float, p))) for p in points]
    lines += [f"CELLS {len(tets)} {5 * len(tets)}"] + ["4 " + " ".join(map(str, t)) for t in tets]
    lines += [f"CELL_TYPES {len(tets)}"] + ["10"] * len(tets)
    path.write_text("\n".join(lines) + "\n")
    step = 1 / 1000
    pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD)
        pybullet.setGravity(0, -GRAVITY, 0)
        pybullet.setTimeStep(step)
        shear = YOUNG / (2 * (1 + POISSON))
        first = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
        body = pybullet.loadSoftBody(
            str(path), mass=DENSITY * LENGTH * SIDE**2, useNeoHookean=1, NeoHookeanMu=shear, NeoHookeanLambda=first,
            NeoHookeanDamping=0.02, collisionMargin=0.001, useSelfCollision=0, simFileName=str(path),
        )
        read = lambda: np.array(pybullet.getMeshData(body, -1, flags=pybullet.MESH_DATA_SIMULATION_MESH)[1])
        start = read()
        if len(start) != len(points):
            raise RuntimeError(f"{len(start)} nodes instead of {len(points)}")
        for node in np.flatnonzero(start[:, 0] < 1e-6):
            pybullet.createSoftBodyAnchor(body, int(node), -1, -1)
        end = np.flatnonzero(start[:, 0] > LENGTH - 1e-6)
        went, us = settle(pybullet.stepSimulation, lambda: (read()[end] - start[end]).mean(axis=0), 1000)
    finally:
        pybullet.disconnect()
    return went[:2], us, step


def draw(rows, path):
    """Error against the time of a second of motion, both on logarithmic axes, as SVG."""
    width, height, left, top, right, bottom = 900, 520, 80, 30, 260, 60
    told = [r for r in rows if r["error_percent"] is not None]
    x = lambda r: np.log10(r["ms_a_second"])
    y = lambda r: np.log10(r["error_percent"])
    low = [np.floor(min(map(f, told))) for f in (x, y)]
    high = [np.ceil(max(map(f, told))) for f in (x, y)]
    at = lambda u, v: (left + (u - low[0]) / (high[0] - low[0]) * (width - left - right), height - bottom - (v - low[1]) / (high[1] - low[1]) * (height - top - bottom))
    colors = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"]
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" font-size="14">',
           f'<rect width="{width}" height="{height}" fill="white"/>']
    for axis in (0, 1):
        for tick in range(int(low[axis]), int(high[axis]) + 1):
            a, b = (at(tick, low[1]), at(tick, high[1])) if axis == 0 else (at(low[0], tick), at(high[0], tick))
            out.append(f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" stroke="#ddd"/>')
            where = f'x="{a[0]:.1f}" y="{a[1] + 20:.1f}" text-anchor="middle"' if axis == 0 else f'x="{a[0] - 8:.1f}" y="{a[1] + 5:.1f}" text-anchor="end"'
            out.append(f"<text {where}>{10.0**tick:g}</text>")
    out.append(f'<text x="{(left + width - right) / 2}" y="{height - 15}" text-anchor="middle">time for a second of motion on one core, ms</text>')
    out.append(f'<text transform="translate(20 {height / 2}) rotate(-90)" text-anchor="middle">the end is off by, % of the length</text>')
    for i, name in enumerate(dict.fromkeys(r["program"] for r in told)):
        points = sorted((r for r in told if r["program"] == name), key=lambda r: r["ms_a_second"])
        places = [at(x(r), y(r)) for r in points]
        color = colors[i % len(colors)]
        out.append(f'<polyline points="{" ".join(f"{a:.1f},{b:.1f}" for a, b in places)}" fill="none" stroke="{color}" stroke-width="2"/>')
        out += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="5" fill="{color}"><title>{name}, {r["size"]}: {r["error_percent"]:.3g} %</title></circle>' for (a, b), r in zip(places, points)]
        out.append(f'<circle cx="{width - right + 20}" cy="{top + 12 + 24 * i}" r="5" fill="{color}"/><text x="{width - right + 32}" y="{top + 17 + 24 * i}">{name}</text>')
    path.write_text("\n".join([*out, "</svg>"]) + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the coarsest mesh of each program")
    parser.add_argument("--fine", action="store_true", help="a third mesh of 3,240 tetrahedra, which takes long")
    parser.add_argument("--pliant", help="the program; default: cargo run --release")
    parser.add_argument("--only", action="append", help="programs whose name contains this")
    parser.add_argument("-o", "--output", type=pathlib.Path, help="name of the files to write, without an ending")
    args = parser.parse_args()
    if args.output:
        args.output = args.output.resolve()
    if args.pliant:
        args.pliant = str(pathlib.Path(args.pliant).resolve())
    command = [args.pliant] if args.pliant else ["cargo", "run", "--release", "-q", "-p", "pliant_cli", "--"]
    want, load, rows = elastica(), [os.getloadavg()[0]], []
    coarse, middle, fine = (20, 1, 1), (40, 2, 2), (60, 3, 3)
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        # MuJoCo writes its log where it runs.
        os.chdir(folder)
        name = lambda cells: f"{6 * np.prod(cells)} tetrahedra"
        jobs = []
        for coordinates in (5, 10, 20, 40):
            jobs.append(("Pliant, linear with warp", f"{coordinates} modes", lambda n=coordinates: pliant(command, folder, middle, n, "linear")))
        for coordinates in (10, 15, 20, 30, 40):
            jobs.append(("Pliant, reduced", f"{coordinates} coordinates", lambda n=coordinates: pliant(command, folder, middle, n, "reduced")))
        for cells in (coarse, middle, fine)[: 3 if args.fine else 2]:
            jobs.append(("MuJoCo flex", name(cells), lambda c=cells: mujoco_flex(c)))
            jobs.append(("PyBullet, neo-Hookean", name(cells), lambda c=cells: bullet(c, folder)))
            jobs.append(("Rapier, constraints", name(cells), lambda c=cells: rapier(c, "CONSTRAINTS", "COROTATIONAL")))
            jobs.append(("Rapier, neo-Hookean", name(cells), lambda c=cells: rapier(c, "FEM", "NEO_HOOKEAN")))
        done = set()
        for program, size, work in jobs:
            if args.only and not any(part in program for part in args.only) or args.quick and program in done:
                continue
            done.add(program)
            row = {"program": program, "size": size, "error_percent": None, "along": None, "down": None, "step_us": None, "ms_a_second": None, "told": ""}
            try:
                (along, down), us, step = work()
                off = 100 * float(np.hypot(along - want[0], down - want[1])) / LENGTH
                row |= {"error_percent": off, "along": float(along), "down": float(down), "step_us": us, "ms_a_second": us / step * 1e-3}
            except Exception as error:  # a peer that is not there, or refuses, is told and the others go on
                row["told"] = str(error).splitlines()[0]
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
        os.chdir(ROOT)
    load.append(os.getloadavg()[0])
    rows.sort(key=lambda r: r["program"])
    versions = ", ".join(f"{k} {version(k)}" for k in ("pybullet", "mujoco", "rapier3d"))
    lines = [
        "# Error against run time, beside peers", "",
        f"{time.strftime('%Y-%m-%d')}, {os.cpu_count()} cores, {platform.machine()}; {versions}. Load of the machine at the start and the end: "
        f"{load[0]:.1f} and {load[1]:.1f}. Remade by `python3 benches/peers/hang.py -o docs/report/hang`.", "",
        f"A bar of {LENGTH:g} m x {SIDE:g} m x {SIDE:g} m (E {YOUNG:g} Pa, nu {POISSON:g}, {DENSITY:g} kg/m^3) hangs from a wall under {GRAVITY:g} m/s^2. Its end is "
        f"{-want[1]:.4f} m lower and {-want[0]:.4f} m nearer to the wall by the heavy elastica, which is the reference.", "",
        "![Error against run time](hang.svg)", "",
        "| program | size | the end is off by, % of the length | end along and down, m | a step, us | a second of motion, ms |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for r in rows:
        if r["error_percent"] is None:
            lines.append(f"| {r['program']} | {r['size']} | not measured: {r['told']} | | | |")
        else:
            lines.append(f"| {r['program']} | {r['size']} | {r['error_percent']:.3g} | {r['along']:.4f}, {r['down']:.4f} | {r['step_us']:.3g} | {r['ms_a_second']:.3g} |")
    lines += ["", "*Size*: ours are modes of 960 tetrahedra of ten nodes; the others step linear tetrahedra of the same grid, and finer ones would bring them nearer. *Step*: ours is 1/60 s, with a hand and without writing the surface; MuJoCo's is the longest of 1/120 s and its halves at which it is stable, with its integrator `discrete`; PyBullet's is 1/1000 s and Rapier's 1/240 s, as chosen here. Positions of all nodes are part of theirs, and so are their collision worlds without contacts."]
    print("\n".join(lines))
    if args.output:
        args.output.with_suffix(".md").write_text("\n".join(lines) + "\n")
        with args.output.with_suffix(".csv").open("w", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)
        draw(rows, args.output.with_suffix(".svg"))


if __name__ == "__main__":
    sys.exit(main())
