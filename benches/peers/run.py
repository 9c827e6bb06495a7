#!/usr/bin/env python3
"""Pliant beside its peers: one mesh, one material, one run, ratios.

    python3 benches/peers/run.py [--json] [--pliant PATH] [-o docs/report/peers.md]

Needs numpy and scipy; takes pybullet, mujoco, exudyn and rapier3d where they are installed (all on PyPI) and says so where not. Every peer is asked for a
step of the same free bar of 1,080 tetrahedra (1 m x 0.15 m x 0.15 m, E 2e5 Pa, nu 0.3, 1000 kg/m^3), and what it computes in that time is said beside the
number. Each is checked to have moved as Newton says (a free fall, or a pull at the end) before its time counts. Steps differ in length, so that the time of a
second of motion stands beside that of a step. One thread each; our eigensolver and SciPy's take turns, and the fastest of several
rounds of each counts: ours is a new process each time, SciPy's is warm.
"""

import argparse, importlib.metadata, json, os, pathlib, platform, struct, subprocess, sys, tempfile, time, warnings

for pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ[pool] = "1"

try:
    import numpy as np
    from scipy.io import mmread
    from scipy.sparse.linalg import eigsh
except ImportError as error:
    print(f"skipped: {error} (pip install numpy scipy)")
    sys.exit(77)

CELLS, SIZE, MODES = (20, 3, 3), (1.0, 0.15, 0.15), 20
YOUNG, POISSON, DENSITY = 2e5, 0.3, 1000.0
ROOT = pathlib.Path(__file__).resolve().parents[2]


ROUNDS = 7


def median_us(work, repeats, warm=20):
    for _ in range(warm):
        work()
    samples = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        samples.append((time.perf_counter() - began) * 1e6)
    return float(np.median(samples)), float(np.percentile(samples, 99))


class Pliant:
    def __init__(self, path, folder):
        self.command = [path] if path else ["cargo", "run", "--release", "-q", "-p", "pliant_cli", "--"]
        self.folder = folder

    def __call__(self, *arguments):
        done = subprocess.run([*self.command, *map(str, arguments)], cwd=ROOT, check=True, capture_output=True, text=True)
        return done.stdout

    def bar(self, cells, folder):
        self("mesh", "bar", "--cells", ",".join(map(str, cells)), "--size", ",".join(map(str, SIZE)), "-o", folder / "bar.vtk")

    def bake(self, modes, folder, *more):
        """Frequencies and seconds of factor and modes, of one bake."""
        told = json.loads(self("bake", folder / "bar.vtk", "--element", "tet4", "--modes", modes, "--young", YOUNG, "--poisson", POISSON,
                               "--density", DENSITY, "--no-cache", "--threads", 1, *more, "-o", folder / "bar.modal", "--json"))
        return {"frequencies": told["frequencies_hz"], "modes_s": told["seconds"]["factor"] + told["seconds"]["modes"], "tets": told["tets"]}

    def step(self):
        stepped = json.loads(self("bench", "step", self.folder / "bar.modal", "--json"))
        return {"step_us": stepped["step_us"]["p50"], "frame_us": stepped["frame_us"]["p50"]}


def read_vtk(path):
    """Points and tetrahedra of a legacy ASCII file."""
    words = iter(path.read_text().split())
    points = tets = None
    for word in words:
        if word == "POINTS":
            count = int(next(words)); next(words)
            points = np.array([float(next(words)) for _ in range(3 * count)]).reshape(-1, 3)
        elif word == "CELLS":
            count = int(next(words)); next(words)
            tets = np.array([int(next(words)) for _ in range(5 * count)]).reshape(-1, 5)[:, 1:]
    return points, tets


def eigensolvers(pliant, folder, cells, modes):
    """Our bake and SciPy's shift-invert Lanczos (ARPACK over SuperLU) on the very matrices of it, by turns: both to 1e-8, factor counted in both."""
    pliant.bar(cells, folder)
    ours = pliant.bake(modes, folder, "--export-matrices", folder)
    stiffness, mass = (mmread(folder / f"{name}.mtx").tocsc() for name in "KM")
    shift = -(2.0 * np.pi * ours["frequencies"][0]) ** 2
    mine, theirs = [], []
    # A round before those that count: the first call of either loads libraries and pages.
    for turn in range(ROUNDS + 1):
        again = pliant.bake(modes, folder)["modes_s"]
        began = time.perf_counter()
        values, vectors = eigsh(stiffness, k=modes + 6, M=mass, sigma=shift, tol=1e-8)
        seconds = time.perf_counter() - began
        if turn > 0:
            mine.append(again)
            theirs.append(seconds)
    order = np.argsort(values)[6:]
    hertz = np.sqrt(values[order]) / (2.0 * np.pi)
    off = float(np.max(np.abs(hertz / np.array(ours["frequencies"]) - 1.0)))
    # The fastest round of each: whatever else the machine does only adds.
    ours["modes_s"] = min(mine)
    spread = f"{min(mine):.2g} to {max(mine):.2g} s and {min(theirs):.2g} to {max(theirs):.2g} s in {ROUNDS} rounds by turns"
    return ours, min(theirs), off, spread, (values[order], vectors[:, order], np.asarray(mass.sum(axis=1)).ravel()[::3])


def fell(name, drop, steps, step, tolerance):
    """A free fall from rest for so many steps, or an error: between the sums of a velocity-first and of a position-first rule, give or take."""
    seconds = steps * step
    want = 0.5 * 9.81 * seconds**2
    if not abs(drop / want - 1.0) < tolerance + 1.0 / steps:
        raise RuntimeError(f"{name}'s bar fell {drop} m in {seconds} s, and Newton says {want} m")


def bullet(folder, values, vectors, nodal_mass):
    import pybullet

    points, tets = read_vtk(folder / "bar.vtk")
    place = folder / "bullet"
    place.mkdir()
    lines = ["# vtk DataFile Version 2.0", "bar", "ASCII", "DATASET UNSTRUCTURED_GRID", f"POINTS {len(points)} double"]
    lines += [" ".join(map(repr, map(float, p))) for p in points]
    lines += [f"CELLS {len(tets)} {5 * len(tets)}"] + ["4 " + " ".join(map(str, t)) for t in tets]
    lines += [f"CELL_TYPES {len(tets)}"] + ["10"] * len(tets)
    (place / "bar.vtk").write_text("\n".join(lines) + "\n")

    def numbers(name, array):
        flat = np.ascontiguousarray(array, dtype="<f8").ravel()
        (place / name).write_bytes(struct.pack("<I", flat.size) + flat.tobytes())

    # Mass-normalised modes: the reduced stiffness is the eigenvalue itself.
    numbers("eigenvalues.bin", values)
    numbers("K_r_diag_mat.bin", values)
    numbers("modes.bin", vectors.T)
    numbers("M_diag_mat.bin", nodal_mass)
    (place / "bar.urdf").write_text(
        f"""<?xml version="1.0"?>
<robot name="bar"><reduced_deformable name="bar"><num_modes value="{MODES}"/><mass value="{nodal_mass.sum()}"/>
<stiffness_scale value="1"/><collision_margin value="0.001"/><erp value="0.2"/><cfm value="0.2"/><friction value="0.5"/>
<damping_coefficient value="0.0001"/><visual filename="bar.vtk"/></reduced_deformable></robot>"""
    )
    pybullet.connect(pybullet.DIRECT)
    pybullet.resetSimulation(pybullet.RESET_USE_REDUCED_DEFORMABLE_WORLD)
    pybullet.setGravity(0, 0, -9.81)
    pybullet.setAdditionalSearchPath(str(place))
    pybullet.setTimeStep(1 / 240)
    body = pybullet.loadURDF("bar.urdf", [0, 0, 0])
    if body < 0:
        raise RuntimeError("PyBullet did not take the file")
    where = lambda: float(np.mean([p[2] for p in pybullet.getMeshData(body, -1)[1]]))
    start, steps, warm = where(), 220, 20
    # A step alone: its vertices come to Python as tuples, which is the binding's cost and not the
    # solver's.
    times = median_us(pybullet.stepSimulation, steps, warm)
    drop = start - where()

    def both():
        pybullet.stepSimulation()
        pybullet.getMeshData(body, -1)

    read = median_us(both, 100, 5)
    pybullet.disconnect()
    fell("PyBullet", drop, steps + warm, 1 / 240, 0.02)
    return times, read


def mujoco_flex():
    import mujoco

    spacing = " ".join(str(s / c) for s, c in zip(SIZE, CELLS))
    count = " ".join(str(c + 1) for c in CELLS)
    mass = DENSITY * np.prod(SIZE)
    xml = f"""<mujoco><option timestep="0.0005" gravity="0 0 -9.81"/><size memory="200M"/><worldbody>
      <flexcomp name="bar" type="grid" count="{count}" spacing="{spacing}" mass="{mass}" dim="3" radius="0.001">
      <contact selfcollide="none" contype="0" conaffinity="0"/>
      <elasticity young="{YOUNG}" poisson="{POISSON}" damping="0.001"/></flexcomp></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start, steps, warm = float(np.mean(data.flexvert_xpos[:, 2])), 400, 20
    times = median_us(lambda: mujoco.mj_step(model, data), steps, warm)
    mujoco.mj_forward(model, data)
    fell("MuJoCo", start - float(np.mean(data.flexvert_xpos[:, 2])), steps + warm, 0.0005, 0.02)
    return times, int(model.nv)


def exudyn_floating_frame(folder, values, vectors):
    """Seconds a step of Exudyn's modally reduced floating frame: our matrices, our modes, a force along the bar at its end, no damping."""
    import exudyn
    from exudyn import itemInterface as item
    from exudyn.FEM import FEMinterface, ObjectFFRFreducedOrderInterface

    points, tets = read_vtk(folder / "bar.vtk")
    body = FEMinterface()
    body.nodes, body.elements = {"Position": points}, [{"Name": "bar", "Tet4": tets}]
    body.massMatrix, body.stiffnessMatrix = (mmread(folder / f"{name}.mtx").tocsr() for name in "MK")
    body.modeBasis, body.eigenValues = {"matrix": vectors, "type": "NormalModes"}, values
    # The four nodes about the axis of the end: the bar is pulled straight, so where it goes is
    # known.
    inner = sorted(range(len(points)), key=lambda i: (-points[i][0], np.hypot(points[i][1] - SIZE[1] / 2, points[i][2] - SIZE[2] / 2)))[:4]
    force, mass, step = 20.0, DENSITY * np.prod(SIZE), 1 / 240

    def simulate(steps):
        system = exudyn.SystemContainer().AddSystem()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = ObjectFFRFreducedOrderInterface(body).AddObjectFFRFreducedOrder(system)
            marker = system.AddMarker(item.MarkerSuperElementPosition(bodyNumber=made["oFFRFreducedOrder"], meshNodeNumbers=inner, weightingFactors=[0.25] * 4))
            system.AddLoad(item.LoadForceVector(markerNumber=marker, loadVector=[force, 0, 0]))
            system.Assemble()
            settings = exudyn.SimulationSettings()
            settings.timeIntegration.numberOfSteps, settings.timeIntegration.endTime = steps, steps * step
            settings.timeIntegration.verboseMode, settings.solutionSettings.writeSolutionToFile = 0, False
            # Its own advice for speed: the Jacobian is kept as long as Newton converges.
            settings.timeIntegration.newton.useModifiedNewton = True
            settings.parallel.numberOfThreads = 1
            began = time.perf_counter()
            solved = system.SolveDynamic(settings)
        seconds = time.perf_counter() - began
        went = system.GetNodeOutput(made["nRigidBody"], exudyn.OutputVariableType.Position)[0]
        want = 0.5 * force / mass * (steps * step) ** 2
        if not solved or abs(went - want) > 1e-3 * want:
            raise RuntimeError(f"Exudyn's bar went {went} m, and Newton says {want} m")
        return seconds

    # The difference of a long and a short run: what the solver does before its first step is in
    # neither.
    simulate(60)
    return float(np.median([(simulate(660) - simulate(60)) / 600 for _ in range(7)])) * 1e6


def rapier(folder, solver, model):
    """Median time of a step of Rapier's soft body on the same tetrahedra, us, and how many cells it has."""
    import rapier3d

    points, tets = read_vtk(folder / "bar.vtk")
    world = rapier3d.PhysicsWorld(gravity=(0, 0, -9.81))
    world.integration_parameters.dt = 1 / 240
    world.physics_pipeline.set_num_threads(1)
    builder = (
        rapier3d.SoftBodyBuilder(points)
        .cells(tets.tolist())
        .material(rapier3d.SoftBodyMaterial(young_modulus=YOUNG, poisson_ratio=POISSON))
        .cell_model(getattr(rapier3d.SoftBodyCellModel, model))
        .solver(getattr(rapier3d.SoftBodySolver, solver))
        .mass(DENSITY * np.prod(SIZE))
        .can_sleep(False)
        .no_surface_collider()
    )
    body = world.soft_bodies.insert(builder, world.rigid_bodies, world.colliders)
    where = points

    def step():
        nonlocal where
        world.step()
        where = world.soft_bodies[body].particle_positions

    times = median_us(step, 220, 20)
    # Each of its steps is four smaller ones, velocity first.
    fell("Rapier", float(np.mean(points[:, 2]) - np.mean(where, axis=0)[2]), 240, 1 / 240, 0.02)
    return times


def version(name):
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--pliant", help="the program; default: cargo run --release")
    parser.add_argument("-o", "--output", type=pathlib.Path, help="write the table as Markdown to this file, too")
    args = parser.parse_args()
    rows, load = [], [os.getloadavg()[0]]
    versions = {name: version(name) for name in ("scipy", "pybullet", "mujoco", "exudyn", "rapier3d")}

    def row(name, what, value, ours, unit, computes, step=None, our_step=1 / 240):
        """`step`: seconds of motion of the peer's step; None for what is no step."""
        second = None if value is None or step is None else (value / step * 1e-3, ours / our_step * 1e-3)
        rows.append({"peer": name, "job": what, "peer_value": value, "ours": ours, "unit": unit, "ratio": None if value is None else value / ours,
                     "ms_a_second": second, "ratio_a_second": second and second[0] / second[1], "computes": computes})

    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        pliant = Pliant(args.pliant, folder)
        ours, seconds, off, spread, (values, vectors, nodal_mass) = eigensolvers(pliant, folder, CELLS, MODES)
        ours |= pliant.step()
        row("SciPy eigsh", f"{MODES} modes of the same K and M", seconds, ours["modes_s"], "s",
            f"factor and Lanczos on the same matrices, both to 1e-8; frequencies agree to {off:.0e}; ours and its {spread}")
        (folder / "finer").mkdir()
        finer, finer_seconds, finer_off, finer_spread, _ = eigensolvers(pliant, folder / "finer", (60, 12, 12), 60)
        row("SciPy eigsh", f"60 modes of {finer['tets']} tetrahedra", finer_seconds, finer["modes_s"], "s",
            f"the same on a finer mesh; frequencies agree to {finer_off:.0e}; ours and its {finer_spread}")
        try:
            (step, _), (read, _) = bullet(folder, values, vectors, nodal_mass)
            what = ("the same 20 modes on the same mesh, written in its own format; also the rigid motion, the positions of all nodes and the broad phase of its collision world; "
                    "ours: a step with a hand pulling and the warped surface")
            row("PyBullet reduced deformable", "a step and all vertices, left where they are", step, ours["frame_us"], "us", what, 1 / 240)
            row("PyBullet reduced deformable", "a step and all vertices, read by the caller", read, ours["frame_us"], "us",
                "the same, and `getMeshData`: most of the difference is its Python binding making tuples", 1 / 240)
        except Exception as error:  # a peer that is not there, or refuses, is told and the others go on
            row("PyBullet reduced deformable", "a step and all vertices", None, ours["frame_us"], "us", f"not measured: {error}")
        try:
            (step, _), freedoms = mujoco_flex()
            row("MuJoCo flex", "a step", step, ours["frame_us"], "us",
                f"the full mesh, not modes: {freedoms} degrees of freedom, nonlinear elasticity, steps of 0.5 ms (that is what it is stable at), contacts off", 0.0005)
        except Exception as error:
            row("MuJoCo flex", "a step", None, ours["frame_us"], "us", f"not measured: {error}")
        try:
            row("Exudyn modal floating frame", "a step", exudyn_floating_frame(folder, values, vectors), ours["step_us"], "us",
                "the same 20 modes and matrices in its floating frame of reference, implicit generalized-alpha with the frame's inertia coupling exact, a force at the end, "
                "1/240 s; no surface; ours: a step with a hand pulling, no surface", 1 / 240)
        except Exception as error:
            row("Exudyn modal floating frame", "a step", None, ours["step_us"], "us", f"not measured: {error}")
        for solver, model, words in (("CONSTRAINTS", "COROTATIONAL", "corotational cells as constraints (its default solver)"),
                                     ("FEM", "NEO_HOOKEAN", "neo-Hookean cells, implicit (its feature `fem`)")):
            name = f"Rapier soft body, {solver.lower()}"
            try:
                step, _ = rapier(folder, solver, model)
                row(name, "a step and all vertices", step, ours["frame_us"], "us",
                    f"the full mesh, not modes: {words}, 1/240 s in four smaller steps, contacts off, positions of all particles read", 1 / 240)
            except Exception as error:
                row(name, "a step and all vertices", None, ours["frame_us"], "us", f"not measured: {error}")
    load.append(os.getloadavg()[0])
    if args.json:
        print(json.dumps({"rows": rows, "ours": ours, "versions": versions, "load": load}))
        return
    lines = [
        "# Pliant beside its peers", "",
        f"{time.strftime('%Y-%m-%d')}, {os.cpu_count()} cores, {platform.machine()}; {', '.join(f'{k} {v}' for k, v in versions.items())}. "
        f"Load of the machine at the start and the end: {load[0]:.1f} and {load[1]:.1f}. Remade by `python3 benches/peers/run.py -o docs/report/peers.md`.", "",
        "| peer | job | peer | ours | times ours | ms for a second of motion, peer / ours at 240 steps | times ours | what it computes |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for r in rows:
        value = "" if r["peer_value"] is None else f"{r['peer_value']:.4g} {r['unit']}"
        ratio = "" if r["ratio"] is None else f"{r['ratio']:.3g}"
        second = r["ms_a_second"] and f"{r['ms_a_second'][0]:.4g} / {r['ms_a_second'][1]:.3g}"
        again = r["ratio_a_second"] and f"{r['ratio_a_second']:.3g}"
        lines.append(f"| {r['peer']} | {r['job']} | {value} | {r['ours']:.4g} {r['unit']} | {ratio} | {second or ''} | {again or ''} | {r['computes']} |")
    slower = [f"{r['peer']} ({r['job']})" for r in rows if r["ratio"] is not None and r["ratio"] < 1.0]
    missing = [r["peer"] for r in rows if r["ratio"] is None]
    lines += ["", f"Faster than ours in this run: {', '.join(slower) or 'none'}. Not measured: {', '.join(missing) or 'none'}."]
    print("\n".join(lines))
    if args.output:
        args.output.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    sys.exit(main())
