"""Error beside run time: a bar that hangs from a wall under its own weight.

A bar of 1 m x 0.05 m x 0.05 m (E 2.9e6 Pa, nu 0.3, 1000 kg/m^3) is fixed at one end and hangs under
half the gravity of the earth, which bends its end down by two thirds of its length. The reference
is none of the programs: it is the heavy elastica, E I t'' = w (L - s) cos t, solved here. Each
program gets meshes of several sizes, comes to rest in its own way, and is told its error (how far
its end is from the elastica's, in percent of the length) beside the time of a step and of the steps
of a second, one thread each. These steps are at rest or near it: `run.py`, which calls this, says
which they are. Rounds are by turns with one row of ours.
"""

import json, pathlib, sys, tempfile, time, warnings

from common import LIMIT, ROUNDS, exudyn_settings, figure, ratios, same_frequencies, within, write_vtk

import numpy as np
from scipy.integrate import solve_bvp
from scipy.io import mmread
from scipy.sparse.linalg import eigsh

LENGTH, SIDE = 1.0, 0.05
YOUNG, POISSON, DENSITY, GRAVITY = 2.9e6, 0.3, 1000.0, 0.5 * 9.81
# Timed steps of the body at rest, in each round.
TIMED = 100
GRIDS = (20, 1, 1), (40, 2, 2), (60, 3, 3)
REDUCED, WARPED = "Pliant, reduced", "Pliant, linear with warp"
FOUR = ", four nodes"
# The row that the others' rounds take turns with.
BESIDE = (REDUCED, "20 coordinates of 960 tetrahedra")


def count(cells):
    return 6 * int(np.prod(cells))


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


def settle(step, where, second, beside, rounds, seconds=100):
    """Steps until the end stays where it is.

    Returns where that is, and rounds of our time and its, of the steps of a second at rest, ms.
    `second`: steps of a second. `beside`: measures ours.
    """
    last = where()
    for _ in range(seconds):
        for _ in range(second):
            step()
        now, before = where(), last
        if np.linalg.norm(now - before) < 1e-5 * LENGTH:
            break
        last = now
    else:
        raise RuntimeError(f"not at rest after {seconds} s: its end still moves by {np.linalg.norm(now - before):.1e} m/s")
    if not np.isfinite(now).all():
        raise RuntimeError("blew up")
    pairs = []
    for _ in range(rounds):
        ours, samples = beside(), []
        for _ in range(TIMED):
            began = time.perf_counter()
            step()
            samples.append(time.perf_counter() - began)
        pairs.append((ours, float(np.median(samples)) * second * 1e3))
    return now[:2], pairs


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


class Ours:
    """A model of ours that hangs."""

    def __init__(self, pliant, folder, cells, coordinates, elasticity, element):
        self.pliant, self.elasticity = pliant, elasticity
        mesh, self.model = folder / "bar.vtk", folder / "bar.modal"
        pliant("mesh", "bar", "--cells", ",".join(map(str, cells)), "--size", f"{LENGTH},{SIDE},{SIDE}", "-o", mesh)
        material = "neo-hookean" if elasticity == "reduced" else "linear"
        told = pliant.bake(mesh, self.model, element, coordinates, material, YOUNG, POISSON, DENSITY, "--anchor", "x<1e-9")
        if told["tets"] != count(cells):
            raise RuntimeError(f"{told['tets']} tetrahedra")

    def pull(self, gravity, *more):
        # The hand holds the wall's side of the bar, where nothing moves: a step of this costs what
        # one with a hand costs.
        told = json.loads(self.pliant("pull", self.model, "--at", f"0,{SIDE / 2},{SIDE / 2}", "--radius", 0.02, "--by", "0,0,0", "--gravity", f"0,{-gravity},0",
                                      "--elasticity", self.elasticity, *more, "--json"))
        if told["elasticity"] != self.elasticity:
            raise RuntimeError(f"elasticity is {told['elasticity']}")
        if not told["at_rest"]:
            raise RuntimeError("not at rest")
        return told

    def end(self):
        """How far the end moves, m."""
        moved, rest = self.model.with_name("moved.ply"), self.model.with_name("rest.ply")
        self.pull(GRAVITY, "--surface", moved)
        self.pull(0.0, "--surface", rest)
        moved, rest = read_ply(moved), read_ply(rest)
        end = end_of(rest)
        return (moved[end] - rest[end]).mean(axis=0)[:2]

    def time(self):
        """Of the steps of a second, ms: the median of 4,000 at least, to rest and on."""
        return self.pull(GRAVITY)["step_us"]["p50"] * 60 * 1e-3


def read_ply(path):
    data = path.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    count = int(next(line for line in head.decode().splitlines() if line.startswith("element vertex")).split()[-1])
    if b"format ascii" in head:
        return np.array([[float(x) for x in line.split()[:3]] for line in body.decode().splitlines()[:count]])
    kind = "<f8" if b"property double x" in head else "<f4"
    return np.frombuffer(body, kind, 3 * count).reshape(-1, 3).astype(float)


def rapier(cells, solver, model, beside, rounds):
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
    went, pairs = settle(world.step, where, 240, beside, rounds)
    return went, step, pairs


def mujoco_flex(cells, beside, rounds):
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
        try:
            went, pairs = settle(lambda: mujoco.mj_step(model, data), lambda: (data.flexvert_xpos[end] - start[end]).mean(axis=0), per_second, beside, rounds)
        except RuntimeError:
            if not unstable():
                raise
        if unstable():
            continue
        if np.abs(data.flexvert_xpos[held] - start[held]).max() > 1e-6:
            raise RuntimeError("the wall's vertices moved")
        return went, 1 / per_second, pairs
    raise RuntimeError("unstable with steps of 1/16,000 s")


def bullet(cells, folder, beside, rounds):
    import pybullet

    points, tets = grid(cells)
    path = folder / "bullet.vtk"
    write_vtk(path, points, tets)
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
        went, pairs = settle(pybullet.stepSimulation, lambda: (read()[end] - start[end]).mean(axis=0), 1000, beside, rounds)
    finally:
        pybullet.disconnect()
    return went, step, pairs


def exudyn_floating_frame(pliant, cells, element, modes, folder, beside, rounds):
    """Exudyn's modally reduced floating frame, fixed to the ground, with clamped modes of our matrices."""
    import exudyn
    from exudyn import itemInterface as item
    from exudyn.FEM import FEMinterface, ObjectFFRFreducedOrderInterface

    points, tets = grid(cells)
    mesh = folder / "bar.vtk"
    pliant("mesh", "bar", "--cells", ",".join(map(str, cells)), "--size", f"{LENGTH},{SIDE},{SIDE}", "-o", mesh)
    bake = lambda *more: pliant.bake(mesh, folder / "bar.modal", element, modes, "linear", YOUNG, POISSON, DENSITY, *more)
    # Of the free bar, so that the rows of the wall's nodes are there, too.
    bake("--export-matrices", folder)
    stiffness, mass = (mmread(folder / f"{name}.mtx").tocsr() for name in "KM")
    ours = bake("--anchor", "x<1e-9")["frequencies_hz"]
    nodes = points
    if element == "tet10":
        # The middles of the edges follow the corners.
        edges = sorted({tuple(sorted((int(t[a]), int(t[b])))) for t in tets for a in range(4) for b in range(a)})
        nodes = np.vstack([points, [(points[a] + points[b]) / 2 for a, b in edges]])
    turned = np.stack([-nodes[:, 1], nodes[:, 0], 0 * nodes[:, 0]], axis=1).ravel()
    if np.abs(stiffness @ turned).max() > 1e-9 * np.abs(stiffness).max():
        raise RuntimeError("nodes of the matrices are not where they are thought to be")
    free = np.flatnonzero(np.repeat(nodes[:, 0] > 1e-9, 3))
    values, vectors = eigsh(stiffness[free][:, free].tocsc(), k=modes, M=mass[free][:, free].tocsc(), sigma=0.0, tol=1e-10)
    same_frequencies(ours, np.sqrt(np.sort(values)) / (2.0 * np.pi))
    shapes = np.zeros((3 * len(nodes), modes))
    shapes[free] = vectors
    body = FEMinterface()
    body.nodes, body.elements = {"Position": nodes}, [{"Name": "bar", "Tet4": tets}]
    body.massMatrix, body.stiffnessMatrix = mass, stiffness
    body.modeBasis, body.eigenValues = {"matrix": shapes, "type": "NormalModes"}, values
    end, step = end_of(nodes), 1 / 240

    def simulate(steps):
        system = exudyn.SystemContainer().AddSystem()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = ObjectFFRFreducedOrderInterface(body).AddObjectFFRFreducedOrder(system, gravity=[0, -GRAVITY, 0], massProportionalDamping=5.0)
            ground = system.AddMarker(item.MarkerBodyRigid(bodyNumber=system.AddObject(item.ObjectGround())))
            frame = system.AddMarker(item.MarkerNodeRigid(nodeNumber=made["nRigidBody"]))
            system.AddObject(item.GenericJoint(markerNumbers=[ground, frame], constrainedAxes=[1] * 6))
            system.Assemble()
            settings = exudyn_settings(exudyn, steps, step)
            began = time.perf_counter()
            if not system.SolveDynamic(settings):
                raise RuntimeError("its solver gave up")
        seconds = time.perf_counter() - began
        moved = shapes @ np.asarray(system.GetNodeOutput(made["nGenericODE2"], exudyn.OutputVariableType.Coordinates))
        return moved.reshape(-1, 3)[end].mean(axis=0), seconds

    now, last = simulate(12 * 240)[0], simulate(11 * 240)[0]
    if np.linalg.norm(now - last) > 1e-5 * LENGTH:
        raise RuntimeError(f"not at rest after 12 s: its end still moves by {np.linalg.norm(now - last):.1e} m/s")
    # The difference of a long and a short run: what the solver does before its first step is in
    # neither.
    pairs = [(beside(), (simulate(660)[1] - simulate(60)[1]) / 600 / step * 1e3) for _ in range(rounds)]
    return now[:2], step, pairs


def jobs(pliant, folder, quick):
    """Program, size, number of tetrahedra, nodes of each, and the work."""
    rounds = 1 if quick else ROUNDS
    coarse, middle, _ = GRIDS
    reference = Ours(pliant, folder, middle, 20, "reduced", "tet10")

    def own(cells, coordinates, elasticity, element):
        place = pathlib.Path(tempfile.mkdtemp(dir=folder))
        body = Ours(pliant, place, cells, coordinates, elasticity, element)
        return body.end(), 1 / 60, [(reference.time(), body.time()) for _ in range(rounds)]

    every = []
    for elasticity, name, kind, sizes in (("linear", WARPED, "modes", (5, 10, 20, 40)), ("reduced", REDUCED, "coordinates", (10, 15, 20, 30, 40))):
        for cells, n in [(middle, n) for n in sizes] + [(cells, 20) for cells in GRIDS if cells != middle]:
            work = lambda c=cells, n=n, e=elasticity: own(c, n, e, "tet10")
            every.append((name if cells == middle else f"{name}, other meshes", f"{n} {kind} of {count(cells)} tetrahedra", count(cells), 10, work))
        for cells in GRIDS:
            every.append((name + FOUR, f"20 {kind} of {count(cells)} tetrahedra", count(cells), 4, lambda c=cells, e=elasticity: own(c, 20, e, "tet4")))
    beside = reference.time
    for cells in GRIDS:
        size = f"{count(cells)} tetrahedra"
        others = [
            ("MuJoCo flex", 4, size, lambda c=cells: mujoco_flex(c, beside, rounds)),
            ("PyBullet, neo-Hookean", 4, size, lambda c=cells: bullet(c, folder, beside, rounds)),
            ("Rapier, constraints", 4, size, lambda c=cells: rapier(c, "CONSTRAINTS", "COROTATIONAL", beside, rounds)),
            ("Rapier, neo-Hookean", 4, size, lambda c=cells: rapier(c, "FEM", "NEO_HOOKEAN", beside, rounds)),
            ("Exudyn floating frame" + FOUR, 4, f"20 modes of {size}", lambda c=cells: exudyn_floating_frame(pliant, c, "tet4", 20, pathlib.Path(tempfile.mkdtemp(dir=folder)), beside, rounds)),
        ]
        if cells in (coarse, middle):
            others.append(("Exudyn floating frame", 10, f"20 modes of {size}", lambda c=cells: exudyn_floating_frame(pliant, c, "tet10", 20, pathlib.Path(tempfile.mkdtemp(dir=folder)), beside, rounds)))
        every += [(name, size, count(cells), nodes, work) for name, nodes, size, work in others]
    every.sort(key=lambda job: not job[0].startswith("Pliant"))
    if quick:
        first = {}
        for job in every:
            first.setdefault(job[0], job)
        every = list(first.values())
    return every


def measure(pliant, folder, quick):
    """The table's rows."""
    want, rows = elastica(), []
    for program, size, tets, nodes, work in jobs(pliant, folder, quick):
        row = {"program": program, "size": size, "tetrahedra": tets, "nodes": nodes, "error_percent": None, "along": None, "down": None, "step_us": None, "ms_a_second": None,
               "ratio_median": None, "ratio_least": None, "ratio_most": None, "told": ""}
        try:
            (along, down), step, pairs = within(LIMIT, work, folder)
            ms = float(np.median([its for _, its in pairs]))
            row |= {"error_percent": 100 * float(np.hypot(along - want[0], down - want[1])) / LENGTH, "along": float(along), "down": float(down), "step_us": ms * step * 1e3, "ms_a_second": ms}
            row |= dict(zip(("ratio_median", "ratio_least", "ratio_most"), ratios(pairs)))
        except Exception as error:  # a program that is not there, or refuses, is told and the others go on
            row["told"] = str(error)
        rows.append(row)
        print(row, file=sys.stderr, flush=True)
    rows.sort(key=lambda r: (not r["program"].startswith("Pliant"), r["program"]))
    return rows


def table(rows):
    """Lines of Markdown."""
    lines = ["| program | size | nodes of each | the end is off by, % of the length | end along and down, m | a step, us | the steps of a second, ms | times 20 coordinates of ours, median (least to most) |",
             "| --- | --- | --- | --- | --- | --- | --- | --- |"]
    for r in rows:
        cells = [r["program"], r["size"], str(r["nodes"])]
        if r["error_percent"] is None:
            cells += [f"not measured: {r['told']}", "", "", "", ""]
        else:
            ratio = f"{figure(r['ratio_median'])} ({figure(r['ratio_least'])} to {figure(r['ratio_most'])})"
            cells += [f"{r['error_percent']:.3g}", f"{r['along']:.4f}, {r['down']:.4f}", figure(r["step_us"]), figure(r["ms_a_second"]), ratio]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def draw(rows, path):
    """Error against the time of the steps of a second, both on logarithmic axes, as SVG."""
    width, height, left, top, right, bottom = 980, 540, 80, 30, 310, 60
    told = [r for r in rows if r["error_percent"] is not None]
    if not told:
        return
    x = lambda r: np.log10(r["ms_a_second"])
    y = lambda r: np.log10(r["error_percent"])
    low = [np.floor(min(map(f, told))) for f in (x, y)]
    high = [max(np.ceil(max(map(f, told))), least + 1) for f, least in zip((x, y), low)]
    at = lambda u, v: (left + (u - low[0]) / (high[0] - low[0]) * (width - left - right), height - bottom - (v - low[1]) / (high[1] - low[1]) * (height - top - bottom))
    colors = {REDUCED: "#0072b2", WARPED: "#009e73", "MuJoCo": "#d55e00", "PyBullet": "#cc79a7", "Rapier, c": "#e69f00", "Rapier, n": "#8b5a00", "Exudyn": "#000000"}
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" font-size="14">',
           f'<rect width="{width}" height="{height}" fill="white"/>']
    for axis in (0, 1):
        for tick in range(int(low[axis]), int(high[axis]) + 1):
            for minor in range(2, 10) if tick < high[axis] else ():
                u = tick + np.log10(minor)
                a, b = (at(u, low[1]), at(u, high[1])) if axis == 0 else (at(low[0], u), at(high[0], u))
                out.append(f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" stroke="#f0f0f0"/>')
            a, b = (at(tick, low[1]), at(tick, high[1])) if axis == 0 else (at(low[0], tick), at(high[0], tick))
            out.append(f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" stroke="#bbb"/>')
            where = f'x="{a[0]:.1f}" y="{a[1] + 20:.1f}" text-anchor="middle"' if axis == 0 else f'x="{a[0] - 8:.1f}" y="{a[1] + 5:.1f}" text-anchor="end"'
            out.append(f"<text {where}>{10.0**tick:g}</text>")
    out.append(f'<text x="{(left + width - right) / 2}" y="{height - 15}" text-anchor="middle">time of the steps of a second on one core, near rest, ms</text>')
    out.append(f'<text transform="translate(20 {height / 2}) rotate(-90)" text-anchor="middle">the end is off by, % of the length</text>')
    # Filled: ten nodes. Hollow: four. Squares: other meshes.
    for i, name in enumerate(dict.fromkeys(r["program"] for r in told)):
        points = sorted((r for r in told if r["program"] == name), key=lambda r: (r["tetrahedra"], r["ms_a_second"]))
        color = next(value for start, value in colors.items() if name.startswith(start))
        fill = color if points[0]["nodes"] == 10 else "white"

        def mark(u, v):
            style = f'fill="{fill}" stroke="{color}" stroke-width="2"'
            return f'<rect x="{u - 4:.1f}" y="{v - 4:.1f}" width="8" height="8" {style}' if name.endswith("other meshes") else f'<circle cx="{u:.1f}" cy="{v:.1f}" r="5" {style}'

        places = [at(x(r), y(r)) for r in points]
        out.append(f'<polyline points="{" ".join(f"{a:.1f},{b:.1f}" for a, b in places)}" fill="none" stroke="{color}" stroke-width="1.5"/>')
        for (u, v), r in zip(places, points):
            tag = "rect" if name.endswith("other meshes") else "circle"
            out.append(f'{mark(u, v)}><title>{name}, {r["size"]}: {r["error_percent"]:.3g} %, {figure(r["ms_a_second"])} ms</title></{tag}>')
        row = top + 12 + 24 * i
        out.append(f'{mark(width - right + 20, row)}/><text x="{width - right + 34}" y="{row + 5}">{name}</text>')
    row = top + 24 * (i + 2)
    for j, words in enumerate(("filled: tetrahedra of ten nodes", "hollow: tetrahedra of four nodes")):
        out.append(f'<text x="{width - right + 14}" y="{row + 20 * j}" fill="#555">{words}</text>')
    path.write_text("\n".join([*out, "</svg>"]) + "\n")
