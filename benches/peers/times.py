"""How long other programs take for what Pliant does: one mesh, one material, rounds by turns.

Every program is asked for a step of the same free bar of 1,080 tetrahedra (1 m x 0.15 m x 0.15 m,
E 2e5 Pa, nu 0.3, 1000 kg/m^3), and what it computes in that time is told beside it. Each is checked
to have moved as Newton says (a free fall, or a pull at the end) before its time counts. Steps
differ in length, so that the time of a second of motion stands beside that of a step. `run.py`
calls this.
"""

import json, struct, sys, time, warnings

from common import LIMIT, ROUNDS, TooLong, exudyn_settings, figure, ratios, same_frequencies, within, write_vtk

import numpy as np
from scipy.io import mmread
from scipy.sparse.linalg import eigsh

CELLS, SIZE, MODES = (20, 3, 3), (1.0, 0.15, 0.15), 20
# Finer meshes for the eigensolvers, and how many modes.
FINER = ((40, 8, 8), 60), ((60, 12, 12), 60)
YOUNG, POISSON, DENSITY = 2e5, 0.3, 1000.0


def median_us(work, repeats, warm=20):
    for _ in range(warm):
        work()
    samples = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        samples.append((time.perf_counter() - began) * 1e6)
    return float(np.median(samples))


def bake(pliant, folder, modes, *more):
    """Frequencies of linear modes, and the seconds of factor and modes."""
    told = pliant.bake(folder / "bar.vtk", folder / "bar.modal", "tet4", modes, "linear", YOUNG, POISSON, DENSITY, *more)
    return {"frequencies": told["frequencies_hz"], "modes_s": told["seconds"]["factor"] + told["seconds"]["modes"], "tets": told["tets"]}


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


def eigensolvers(pliant, folder, cells, modes, rounds, warm):
    """Our bake and SciPy's shift-invert Lanczos (ARPACK over SuperLU) on the very matrices of it.

    By turns: both to 1e-8, the factor counted in both. Ours is a new process each time, SciPy's is
    warm. Returns the rounds, the difference of the frequencies, and SciPy's modes.
    """
    pliant("mesh", "bar", "--cells", ",".join(map(str, cells)), "--size", ",".join(map(str, SIZE)), "-o", folder / "bar.vtk")
    ours = bake(pliant, folder, modes, "--export-matrices", folder)
    stiffness, mass = (mmread(folder / f"{name}.mtx").tocsc() for name in "KM")
    shift = -((2.0 * np.pi * ours["frequencies"][0]) ** 2)
    pairs = []
    # The first call of either may load libraries and pages.
    for turn in range(rounds + warm):
        mine = bake(pliant, folder, modes)["modes_s"]
        began = time.perf_counter()
        values, vectors = eigsh(stiffness, k=modes + 6, M=mass, sigma=shift, tol=1e-8)
        seconds = time.perf_counter() - began
        order = np.argsort(values)[6:]
        off = same_frequencies(ours["frequencies"], np.sqrt(values[order]) / (2.0 * np.pi))
        if turn >= warm:
            pairs.append((mine, seconds))
    return pairs, off, ours["tets"], (values[order], vectors[:, order], np.asarray(mass.sum(axis=1)).ravel()[::3])


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
    place.mkdir(exist_ok=True)
    write_vtk(place / "bar.vtk", points, tets)

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
    return times


def exudyn_floating_frame(folder, values, vectors):
    """Microseconds a step of Exudyn's modally reduced floating frame, without damping.

    Our matrices and modes, and a force along the bar at its end.
    """
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
            settings = exudyn_settings(exudyn, steps, step)
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
    return float(np.median([(simulate(660) - simulate(60)) / 600 for _ in range(3)])) * 1e6


def rapier(folder, solver, model):
    """Median time of a step of Rapier's soft body on the same tetrahedra, us."""
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


def measure(pliant, folder, quick):
    """The table's rows."""
    rows, rounds = [], 1 if quick else ROUNDS

    def row(name, job, unit, computes, pairs, step=None):
        """`step`: seconds of motion of the other's step, where ours is 1/240 s."""
        told = {"program": name, "job": job, "unit": unit, "its": None, "ours": None, "computes": computes}
        told |= {f"{kind}_{end}": None for kind in ("ratio", "second") for end in ("median", "least", "most")}
        if pairs:
            told |= {"ours": float(np.median([a for a, _ in pairs])), "its": float(np.median([b for _, b in pairs]))}
            told |= dict(zip(("ratio_median", "ratio_least", "ratio_most"), ratios(pairs)))
            if step is not None:
                told |= dict(zip(("second_median", "second_least", "second_most"), (x / (240 * step) for x in ratios(pairs))))
        rows.append(told)
        print(told, file=sys.stderr, flush=True)

    def eigensolver_row(cells, modes, found):
        pairs, off, tets, modes_found = found
        row("SciPy eigsh", f"{modes} modes of {tets} tetrahedra", "s", f"factor and Lanczos on the same matrices, both to 1e-8; frequencies agree to {off:.0e}", pairs)
        return modes_found

    values, vectors, nodal_mass = eigensolver_row(CELLS, MODES, eigensolvers(pliant, folder, CELLS, MODES, rounds, 1))
    for cells, modes in () if quick else FINER:
        place = folder / f"{cells[0]}"
        place.mkdir()
        try:
            eigensolver_row(cells, modes, within(LIMIT, lambda: eigensolvers(pliant, place, cells, modes, rounds, 0), place))
        except TooLong as error:
            row("SciPy eigsh", f"{modes} modes of {6 * int(np.prod(cells))} tetrahedra", "s", f"not measured: {error}", [])

    def step():
        stepped = json.loads(pliant("bench", "step", folder / "bar.modal", "--seconds", 0.4, "--json"))
        if stepped["modes"] != MODES:
            raise RuntimeError(f"the model has {stepped['modes']} modes")
        return {kind: stepped[f"{kind}_us"]["p50"] for kind in ("step", "frame")}

    def peer(name, work, kind, seconds, *jobs):
        """`work` gives a time for each of the jobs. `kind`: a step of ours, or with its surface.

        In this process: PyBullet's reduced body ends with a fault of memory in a forked one.
        """
        try:
            each = [(step()[kind], work()) for _ in range(rounds)]
            for i, (job, computes) in enumerate(jobs):
                row(name, job, "us", computes, [(ours, its[i]) for ours, its in each], seconds)
        except Exception as error:  # a peer that is not there, or refuses, is told and the others go on
            row(name, jobs[0][0], "us", f"not measured: {(str(error) or type(error).__name__).splitlines()[0]}", [])

    peer("PyBullet reduced deformable", lambda: bullet(folder, values, vectors, nodal_mass), "frame", 1 / 240,
         ("a step and all vertices, left where they are", "the same 20 modes on the same mesh, written in its own format; also the rigid motion, the positions of all nodes and the broad phase of its "
          "collision world; ours: a step with a hand pulling and the warped surface"),
         ("a step and all vertices, read by the caller", "the same, and `getMeshData`: most of the difference is its Python binding making tuples"))
    peer("MuJoCo flex", lambda: [mujoco_flex()], "frame", 0.0005,
         ("a step", "the full mesh, not modes: nonlinear elasticity, steps of 0.5 ms (that is what it is stable at), contacts off"))
    peer("Exudyn modal floating frame", lambda: [exudyn_floating_frame(folder, values, vectors)], "step", 1 / 240,
         ("a step", "the same 20 modes and matrices in its floating frame of reference, implicit generalized-alpha with the frame's inertia coupling exact, a force at the end; no surface; ours: "
          "a step with a hand pulling, no surface"))
    for solver, model, words in (("CONSTRAINTS", "COROTATIONAL", "corotational cells as constraints (its default solver)"),
                                 ("FEM", "NEO_HOOKEAN", "neo-Hookean cells, implicit (its feature `fem`)")):
        peer(f"Rapier soft body, {solver.lower()}", lambda: [rapier(folder, solver, model)], "frame", 1 / 240,
             ("a step and all vertices", f"the full mesh, not modes: {words}, 1/240 s in four smaller steps, contacts off, positions of all particles read"))
    return rows


def table(rows):
    """Lines of Markdown."""
    lines = ["| program | job | its time | ours | times ours, median (least to most) | times ours for a second of motion | what it computes |",
             "| --- | --- | --- | --- | --- | --- | --- |"]
    for r in rows:
        cells = [r["program"], r["job"]]
        if r["its"] is None:
            cells += ["", "", "", ""]
        else:
            told = lambda kind: f"{figure(r[f'{kind}_median'])} ({figure(r[f'{kind}_least'])} to {figure(r[f'{kind}_most'])})"
            cells += [f"{figure(r['its'])} {r['unit']}", f"{figure(r['ours'])} {r['unit']}", told("ratio"), "" if r["second_median"] is None else told("second")]
        lines.append(f"| {' | '.join([*cells, r['computes']])} |")
    faster = [f"{r['program']} ({r['job']})" for r in rows if r["its"] is not None and r["ratio_median"] < 1.0]
    missing = [f"{r['program']} ({r['job']})" for r in rows if r["its"] is None]
    return [*lines, "", f"Faster than Pliant in this run: {', '.join(faster) or 'none'}. Not measured: {', '.join(missing) or 'none'}."]
