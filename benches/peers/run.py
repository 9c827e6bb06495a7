#!/usr/bin/env python3
"""Pliant beside other programs: what error each has, and what time it takes for it.

    python3 benches/peers/run.py [--quick] [--pliant PATH] [-o docs/report/peers.md]

Needs numpy and scipy; takes pybullet, mujoco, exudyn and rapier3d where they are installed (all on
PyPI) and says so where not. `hang.py` has the errors, `times.py` the times of the same work. Beside
X.md it writes X.svg, X-error.csv and X-times.csv.
"""

import argparse, csv, pathlib, sys, tempfile

from common import LIMIT, ROUNDS, Pliant, figure, span

import hang
import stamp
import times

PACKAGES = "scipy", "numpy", "pybullet", "mujoco", "exudyn", "rapier3d"


def summary(rows):
    """Three sentences. What was not measured is not in them."""
    told = [r for r in rows if r["error_percent"] is not None]
    ours = lambda name: [r for r in told if r["program"] == name]
    errors = lambda some: f"{span([r['error_percent'] for r in some])} % of the length"
    costs = lambda some: f"{span([r['ms_a_second'] for r in some])} ms"
    others = [r for r in told if not r["program"].startswith("Pliant")]
    middle = hang.count(hang.GRIDS[1])
    same = lambda some: [r for r in some if r["tetrahedra"] == middle and r["nodes"] == 4]
    lines = []
    if ours(hang.REDUCED) and ours(hang.WARPED):
        lines.append(f"Pliant's reduced elasticity on {middle} tetrahedra of ten nodes puts the end of a hanging bar off by {errors(ours(hang.REDUCED))} and takes "
                     f"{costs(ours(hang.REDUCED))} for the steps of a second; its linear elasticity with warp is off by {errors(ours(hang.WARPED))} and takes {costs(ours(hang.WARPED))}.")
    if others:
        best, quickest = min(others, key=lambda r: r["error_percent"]), min(others, key=lambda r: r["ms_a_second"])
        name = lambda r: f"{r['program']} with {r['size']}"
        lines.append(f"Of the others, {name(best)} has the least error, {errors([best])} for {costs([best])}, and {name(quickest)} takes the least time, {costs([quickest])} for "
                     f"{errors([quickest])}; all of them are off by {errors(others)}.")
    four = same(ours(hang.REDUCED + hang.FOUR) + ours(hang.WARPED + hang.FOUR))
    if four and same(others):
        lines.append(f"Like beside like, on {middle} tetrahedra of four nodes, Pliant is off by {errors(four)} for {costs(four)}, and the others by {errors(same(others))} for "
                     f"{costs(same(others))}.")
    return lines


def page(errors, speeds, name, rounds, made, load, versions):
    """Lines of Markdown."""
    along, down = hang.elastica()
    return [
        "# Pliant beside other programs", "",
        f"![Error against run time, of all programs]({name}.svg)", "",
        " ".join(summary(errors)), "",
        "## Errors", "",
        f"A bar of {hang.LENGTH:g} m x {hang.SIDE:g} m x {hang.SIDE:g} m hangs from a wall. The reference is the heavy elastica, which none of the programs is. The last column is the "
        f"time of the steps of a second over that of {hang.BESIDE[0]}, {hang.BESIDE[1]} of ten nodes, in {rounds} by turns with it.", "",
        *hang.table(errors), "",
        "## Times", "",
        f"The same work on a free bar of {times.SIZE[0]:g} m x {times.SIZE[1]:g} m x {times.SIZE[2]:g} m and 1,080 tetrahedra of four nodes, with {times.MODES} linear modes of Pliant's, in {rounds} by "
        "turns. *Its time* and *ours* are medians of the rounds, and the ratios are of each round.", "",
        *times.table(speeds), "",
        "## How it was measured", "",
        f"- Made on {made}. Load of the machine at the start, between the tables and at the end: {', '.join(f'{x:.1f}' for x in load)}. One thread for each program.",
        f"- Versions: {versions}.",
        f"- Remade by `python3 benches/peers/run.py -o docs/report/peers.md`. The plot's figures are in [{name}-error.csv]({name}-error.csv), those of the second table in "
        f"[{name}-times.csv]({name}-times.csv).",
        f"- The hanging bar has E {hang.YOUNG:g} Pa, nu {hang.POISSON:g} and {hang.DENSITY:g} kg/m^3 under {hang.GRAVITY:g} m/s^2. By the elastica its end is {-down:.4f} m lower and {-along:.4f} m nearer "
        f"to the wall. The free bar has E {times.YOUNG:g} Pa, nu {times.POISSON:g} and {times.DENSITY:g} kg/m^3.",
        f"- All programs have the same grids. MuJoCo cuts the cells of a grid into tetrahedra in its own way. A row of the first table, and one of the eigensolvers, is "
        f"ended after {LIMIT} s, and the table says so. An error that is larger on a finer mesh says that the smaller one is where a program crosses the solution, and not that it converges.",
        "- Steps of the hanging bar: Pliant's are 1/60 s, with a hand and without writing the surface. MuJoCo's are the longest of 1/120 s and its halves at which it is stable, with its integrator "
        "`discrete`. PyBullet's are 1/1000 s, and Rapier's and Exudyn's 1/240 s, as chosen here. Positions of all nodes are part of the times of MuJoCo, PyBullet and Rapier, and so are their collision "
        "worlds without contacts. MuJoCo warns at every step that its matrix is nearly singular, and comes to rest all the same.",
        "- Times of the hanging bar are of one that hangs still, or nearly so, and not of one that moves far. Pliant's are the median of all steps from letting go, or from its last shapes of the held patch, to rest and on, 4,000 at least. "
        f"MuJoCo's, PyBullet's and Rapier's are the median of {hang.TIMED} steps at rest. Exudyn's are the mean of the 600 steps from 0.25 s to 2.75 s after letting go, in which the bar swings. "
        "A step of a bar that moves far was not measured, and may take longer where a solver iterates.",
        "- The bar of the eigensolvers is free. SciPy has to find its six rigid modes as well, and is asked for six modes more; Pliant takes them out beforehand.",
        "- Pliant's models are baked before, and Exudyn's modes are made before; that time is in neither table. Each model of Pliant's was asked whether it has the elasticity, the element and the "
        "number of modes of its row.",
        "- Exudyn's floating frame is fixed at the wall and has modes of Pliant's matrices. Its bending in the frame is linear, so it cannot follow a bar that bends this far: finer meshes bring it nearer to "
        "the linear beam, not to the elastica.",
        "- PyBullet's reduced deformable is in the second table only: as a file describes it, it is a free body.",
        "- SOFA was not measured: its Python bindings (SofaPython3) are not on PyPI (tried on 2026-11-27), where `sofa` is the name of another program.",
    ]


def save(rows, path):
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one size and one round of each: to try the script")
    parser.add_argument("--pliant", help="the program; default: cargo run --release")
    parser.add_argument("-o", "--output", type=pathlib.Path, help="write the page to this file, and its plot and tables beside it")
    args = parser.parse_args()
    pliant, load, made = Pliant(args.pliant), [stamp.load()], stamp.machine()
    versions = ", ".join([f"Pliant {pliant.version()}{stamp.commit()}", *(f"{package} {stamp.installed(package)}" for package in PACKAGES)])
    with tempfile.TemporaryDirectory() as folder:
        errors = hang.measure(pliant, pathlib.Path(folder), args.quick)
    load.append(stamp.load())
    with tempfile.TemporaryDirectory() as folder:
        speeds = times.measure(pliant, pathlib.Path(folder), args.quick)
    load.append(stamp.load())
    name = args.output.stem if args.output else "peers"
    lines = page(errors, speeds, name, "one round" if args.quick else f"{ROUNDS} rounds", made, load, versions)
    print("\n".join(lines))
    if args.output:
        args.output.write_text("\n".join(lines) + "\n")
        beside = lambda end: args.output.with_name(f"{name}{end}")
        save(errors, beside("-error.csv"))
        save(speeds, beside("-times.csv"))
        hang.draw(errors, beside(".svg"))


if __name__ == "__main__":
    sys.exit(main())
