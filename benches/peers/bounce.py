"""A ball that falls on a floor: heights and times of its bounce, and the time that it takes.

    python3 benches/peers/bounce.py [--quick] [--pliant PATH] [-o docs/report/bounce.md]

A ball of 10 cm (E 1e7 Pa, nu 0.3, 1000 kg/m^3) falls by 10 cm. Without damping it touches the floor
for the time of Hertz, T = 2.87 (m^2 / (R E*^2 v))^(1/5), the largest force is 4/3 E* sqrt(R) d^1.5
with d = (15 m v^2 / (16 E* sqrt(R)))^(2/5), and it comes back to where it began but for what it
keeps as vibration. Each program gets the same tetrahedra and as little damping as it takes, and is
asked where the mean of the ball's nodes is after each step. What pushes is what that says of its
acceleration. Hertz's law with the ball's weight is measured in the same way at the same steps.
"""

import argparse, csv, json, math, pathlib, sys, tempfile, time

from common import LIMIT, Pliant, figure, within, write_vtk

import numpy as np
import stamp

RADIUS, YOUNG, POISSON, DENSITY, HEIGHT, GRAVITY = 0.1, 1e7, 0.3, 1000.0, 0.1, 9.81
MASS = DENSITY * 4 / 3 * math.pi * RADIUS**3
SPEED = math.sqrt(2 * GRAVITY * HEIGHT)
STIFF = YOUNG / (1 - POISSON**2)
DENT = (15 * MASS * SPEED**2 / (16 * STIFF * math.sqrt(RADIUS))) ** 0.4
EXACT = {
    "contact_ms": 2.87e3 * (MASS**2 / (RADIUS * STIFF**2 * SPEED)) ** 0.2,
    "force_n": 4 / 3 * STIFF * math.sqrt(RADIUS) * DENT**1.5,
    "height_percent": 100.0,
}
FALL = SPEED / GRAVITY
# To the top of the first bounce, and a little on.
SECONDS = 2.2 * FALL
PACKAGES = "numpy", "mujoco", "pybullet", "rapier3d"


class Broken(RuntimeError):
    """What a program made of the ball is no bounce."""


def bounce(step, heights, mass=MASS):
    """Contact time (ms), largest force (N) and height (% of the drop).

    `heights`: of the center, m, one each step (s). The contact time is in whole steps.
    """
    heights = np.asarray(heights)
    if not np.isfinite(heights).all() or np.abs(heights).max() > 100 * HEIGHT + 10 * RADIUS:
        raise Broken("blew up")
    speed = np.diff(heights) / step
    force = mass * (np.diff(speed) / step + GRAVITY)
    pushed = np.flatnonzero(force > 0.02 * force.max())
    first = pushed[0]
    # The ball may be touched again while it rings; the first time that it is not ends the contact.
    apart = np.flatnonzero(np.diff(pushed) > max(2, 2e-3 / step))
    last = pushed[apart[0]] if len(apart) else pushed[-1]
    after = heights[last:]
    if force.max() < mass * GRAVITY:
        raise Broken("it was not stopped")
    start = heights[0]
    touch = start - HEIGHT
    return {"contact_ms": (last - first + 1) * step * 1e3, "force_n": float(force.max()), "height_percent": 100 * float(after.max() - touch) / HEIGHT}


def hertz(rate):
    """What `bounce` says of Hertz's law with gravity, of heights at so many steps a second."""
    stiffness, fine = 4 / 3 * STIFF * math.sqrt(RADIUS), 200
    step = 1 / rate / max(1, fine * 1000 // rate)
    y, v, heights, k = RADIUS + HEIGHT, 0.0, [RADIUS + HEIGHT], round(1 / rate / step)
    push = lambda y: stiffness * max(RADIUS - y, 0.0) ** 1.5 / MASS - GRAVITY
    for _ in range(round(SECONDS * rate)):
        for _ in range(k):
            # Velocity Verlet.
            half = v + 0.5 * step * push(y)
            y += step * half
            v = half + 0.5 * step * push(y)
        heights.append(y)
    return bounce(1 / rate, heights)


def mesh(pliant, folder, cells):
    """Points and tetrahedra of the ball around the origin."""
    path = folder / "ball.vtk"
    pliant("mesh", "sphere", "--cells", cells, "--radius", RADIUS, "-o", path)
    words = path.read_text().split()
    at = words.index("POINTS")
    points = np.array(words[at + 3 : at + 3 + 3 * int(words[at + 1])], float).reshape(-1, 3)
    at = words.index("CELLS")
    tets = np.array(words[at + 3 : at + 3 + 5 * int(words[at + 1])], int).reshape(-1, 5)[:, 1:]
    flipped = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) < 0
    tets[flipped, :2] = tets[flipped, 1::-1]
    return path, points, tets


def ours(pliant, folder, cells, element, elasticity, rate):
    path, _, tets = mesh(pliant, folder, cells)
    model, reduced = folder / "ball.modal", elasticity == "reduced"
    pliant.bake(path, model, element, 36 if reduced else 60, "neo-hookean" if reduced else "linear", YOUNG, POISSON, DENSITY, "--rayleigh", "0,0")
    told = json.loads(pliant("drop", model, "--height", HEIGHT, "--friction", 0, "--gravity", GRAVITY, "--seconds", SECONDS, "--rate", rate, "--elasticity", elasticity, "--json"))
    ticks = told["ticks"]
    heights = [tick["center"][1] for tick in ticks]
    spent = [tick["step_us"] for tick in ticks]
    return len(tets), 1 / rate, heights, float(np.sum(spent)) * 1e-3 / (len(ticks) / rate), told["mass"]


def run(step, seconds, advance, center):
    """Heights of the center after each step (s), and the time for the steps of a second, ms."""
    heights, spent = [center()], 0.0
    for _ in range(round(seconds / step)):
        began = time.perf_counter()
        advance()
        spent += time.perf_counter() - began
        heights.append(center())
    return heights, spent / seconds * 1e3


def lifted(points):
    return points + np.array([0.0, RADIUS + HEIGHT, 0.0])


def rapier(pliant, folder, cells, solver, model, rate):
    import rapier3d

    _, points, tets = mesh(pliant, folder, cells)
    step = 1 / rate
    world = rapier3d.PhysicsWorld(gravity=(0, -GRAVITY, 0))
    world.integration_parameters.dt = step
    world.physics_pipeline.set_num_threads(1)
    world.add_collider(rapier3d.Collider.halfspace((0, 1, 0)).friction(0.0).build())
    material = rapier3d.SoftBodyMaterial(young_modulus=YOUNG, poisson_ratio=POISSON, deformation_damping=0.0, elastic_damping_ratio=0.0)
    builder = (
        rapier3d.SoftBodyBuilder(lifted(points)).cells(tets.tolist()).material(material).cell_model(getattr(rapier3d.SoftBodyCellModel, model))
        .solver(getattr(rapier3d.SoftBodySolver, solver)).mass(MASS).linear_damping(0.0).can_sleep(False)
    )
    body = world.soft_bodies.insert(builder, world.rigid_bodies, world.colliders)
    heights, cost = run(step, SECONDS, world.step, lambda: float(np.asarray(world.soft_bodies[body].particle_positions)[:, 1].mean()))
    return len(tets), step, heights, cost


def mujoco_flex(pliant, folder, cells, rate):
    """The longest step at which it is stable, from the given one down by halves.

    Its contacts are springs with dampers, and those of its default are soft and damped critically,
    so that nothing bounces. These are as stiff as the step can have them, without damping.
    """
    import mujoco

    _, points, tets = mesh(pliant, folder, cells)
    place = " ".join(map(str, lifted(points)[:, [0, 2, 1]].ravel()))
    # Its third axis is up here, so that tetrahedra turn over.
    corners = " ".join(map(str, tets[:, [1, 0, 2, 3]].ravel()))
    while rate <= 64_000:
        xml = f"""<mujoco><option timestep="{1 / rate}" gravity="0 0 {-GRAVITY}" integrator="discrete"/><size memory="400M"/><worldbody>
          <geom type="plane" size="2 2 .1" friction="0 0 0" priority="1" solref="{-(2 * rate) ** 2} 0" solimp="0.99 0.999 0.0001"/>
          <flexcomp name="ball" type="direct" point="{place}" element="{corners}" mass="{MASS}" dim="3" radius="0.0001">
          <contact selfcollide="none" friction="0 0 0"/><elasticity young="{YOUNG}" poisson="{POISSON}" damping="0"/></flexcomp></worldbody></mujoco>"""
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        bad = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{kind}")) for kind in ("QPOS", "QVEL", "QACC")]
        heights, cost = run(1 / rate, SECONDS, lambda: mujoco.mj_step(model, data), lambda: float(data.flexvert_xpos[:, 2].mean()))
        if not any(data.warning[kind].number for kind in bad):
            return len(tets), 1 / rate, heights, cost
        rate *= 2
    raise Broken("unstable with steps of 1/64,000 s")


def bullet(pliant, folder, cells, rate):
    import pybullet

    path, points, tets = mesh(pliant, folder, cells)
    path = folder / "bullet.vtk"
    write_vtk(path, lifted(points), tets)
    step = 1 / rate
    pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD)
        pybullet.setGravity(0, -GRAVITY, 0)
        pybullet.setTimeStep(step)
        floor = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[2, 0.5, 2])
        floor = pybullet.createMultiBody(0, floor, basePosition=[0, -0.5, 0])
        pybullet.changeDynamics(floor, -1, lateralFriction=0.0, restitution=1.0)
        body = pybullet.loadSoftBody(
            str(path), mass=MASS, useNeoHookean=1, NeoHookeanMu=YOUNG / (2 * (1 + POISSON)), NeoHookeanLambda=YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON)),
            NeoHookeanDamping=0.0, collisionMargin=0.0005, useSelfCollision=0, simFileName=str(path), frictionCoeff=0.0, useFaceContact=1,
        )
        read = lambda: float(np.array(pybullet.getMeshData(body, -1, flags=pybullet.MESH_DATA_SIMULATION_MESH)[1])[:, 1].mean())
        heights, cost = run(step, SECONDS, pybullet.stepSimulation, read)
    finally:
        pybullet.disconnect()
    return len(tets), step, heights, cost


def jobs(pliant, folder, quick):
    """Program, cells across, steps a second, and the work."""
    fresh = lambda: pathlib.Path(tempfile.mkdtemp(dir=folder))
    every = []
    for cells in (6,) if quick else (6, 10):
        for elasticity in ("linear", "reduced"):
            for rate in (240, 1000, 4000, 16_000):
                for element in ("tet10", "tet4") if rate == 1000 else ("tet10",):
                    name = f"Pliant, {elasticity}" + (", four nodes" if element == "tet4" else "")
                    every.append((name, cells, rate, lambda c=cells, e=element, k=elasticity, r=rate: ours(pliant, fresh(), c, e, k, r)))
        # The finer mesh takes them minutes.
        for rate in (1000, 4000) if cells == 6 else (1000,):
            every.append(("Rapier, constraints", cells, rate, lambda c=cells, r=rate: rapier(pliant, fresh(), c, "CONSTRAINTS", "COROTATIONAL", r)))
            every.append(("Rapier, neo-Hookean", cells, rate, lambda c=cells, r=rate: rapier(pliant, fresh(), c, "FEM", "NEO_HOOKEAN", r)))
            every.append(("MuJoCo flex", cells, rate, lambda c=cells, r=rate: mujoco_flex(pliant, fresh(), c, r)))
        for rate in (4000, 16_000):
            every.append(("PyBullet, neo-Hookean", cells, rate, lambda c=cells, r=rate: bullet(pliant, fresh(), c, r)))
    return every


def measure(pliant, folder, quick):
    rows = []
    for program, cells, rate, work in jobs(pliant, folder, quick):
        row = {"program": program, "tetrahedra": 6 * cells**3, "steps_a_second": rate, "contact_ms": "", "force_n": "", "height_percent": "", "ms_a_second": "", "why": ""}
        try:
            tets, step, heights, cost, *mass = within(LIMIT, work, folder)
            row |= {"tetrahedra": tets, "steps_a_second": round(1 / step)} | bounce(step, heights, *mass) | {"ms_a_second": cost}
        except (ImportError, RuntimeError, IndexError) as error:
            row["why"] = str(error)
        rows.append(row)
        print(row, file=sys.stderr)
    return rows


def page(rows, made, versions, name):
    """Lines of Markdown."""
    lines = [
        "# A ball that bounces, in Pliant and in other programs", "",
        f"A ball with a radius of {RADIUS:g} m (E {YOUNG:g} Pa, nu {POISSON:g}, {DENSITY:g} kg/m^3) falls by {HEIGHT:g} m on a floor without friction, under {GRAVITY:g} m/s^2. By Hertz's law it touches the "
        f"floor for {EXACT['contact_ms']:.2f} ms with {EXACT['force_n']:.0f} N at most, over a circle of {math.sqrt(RADIUS * DENT) / RADIUS:.2f} of its radius, and comes back to its height, but for what it keeps as "
        "vibration. No program is given damping on purpose. One thread each.", "",
        "| program | tetrahedra | steps a second | contact time, ms | largest force, N | height of the bounce, % | ms for the steps of a second |", "| --- | --- | --- | --- | --- | --- | --- |",
        f"| exact, by Hertz's law | - | - | {EXACT['contact_ms']:.2f} | {EXACT['force_n']:.0f} | 100 | - |",
    ]
    for rate in (240, 1000, 4000, 16_000):
        told = hertz(rate)
        lines.append(f"| Hertz's law with gravity, measured likewise | - | {rate} | {told['contact_ms']:.2f} | {told['force_n']:.0f} | {told['height_percent']:.1f} | - |")
    for row in rows:
        if row["why"]:
            lines.append(f"| {row['program']} | {row['tetrahedra']} | {row['steps_a_second']} | {row['why']} | | | |")
        else:
            lines.append(f"| {row['program']} | {row['tetrahedra']} | {row['steps_a_second']} | {row['contact_ms']:.2f} | {row['force_n']:.0f} | {row['height_percent']:.1f} | {figure(row['ms_a_second'])} |")
    lines += [
        "", f"- Made on {made}. Load of the machine at the end {stamp.load():.1f}.", f"- Versions: {versions}.",
        f"- Remade by `python3 benches/peers/bounce.py -o docs/report/{name}.md`. The figures are in [{name}.csv]({name}.csv).",
        "- The force is that of the acceleration of the mean of the nodes from step to step, and the contact lasts as long as it is above a fiftieth of its largest value, in whole steps; of Pliant it is the center "
        "of mass. Hertz's law, integrated with the ball's weight and sampled at the same steps, is measured in the same way.",
        "- Pliant's ball has the mass of its tetrahedra, 97.2 and 99.0 % of the ball's. The others are given the ball's. Hertz's time is then 1.1 and 0.4 % shorter for Pliant's, and his force 1.7 and 0.6 % smaller.",
        "- Pliant's bodies have 60 modes, or 36 coordinates of reduced elasticity, and were baked before, which is not in the times. The others have three unknowns a node.",
        "- All have the same tetrahedra, Pliant with ten nodes where nothing else is said. Pliant is measured through `pliant drop`, whose time is that of its steps. MuJoCo's steps are halved until it is stable, and "
        "its contacts are as stiff as the step can have them, without damping; those of its default let nothing bounce. PyBullet's floor has a restitution of 1. Rapier's damping of the material is set to 0; its floor and its contacts have its defaults.",
        "- PyBullet's reduced deformable is not among them: it needs a file of its own with modes, and was not tried.",
    ]
    return lines


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one mesh: to try the script")
    parser.add_argument("--pliant", help="the program; default: cargo run --release")
    parser.add_argument("-o", "--output", type=pathlib.Path, help="write the page to this file, and its table beside it")
    args = parser.parse_args()
    pliant, made = Pliant(args.pliant), stamp.machine()
    versions = ", ".join([f"Pliant {pliant.version()}{stamp.commit()}", *(f"{package} {stamp.installed(package)}" for package in PACKAGES)])
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(pliant, pathlib.Path(folder), args.quick)
    name = args.output.stem if args.output else "bounce"
    lines = page(rows, made, versions, name)
    print("\n".join(lines))
    if args.output:
        args.output.write_text("\n".join(lines) + "\n")
        with args.output.with_suffix(".csv").open("w", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)


if __name__ == "__main__":
    sys.exit(main())
