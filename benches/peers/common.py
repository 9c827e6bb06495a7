"""What the scripts beside share: one thread each, the program, and rounds by turns."""

import json, multiprocessing, os, pathlib, signal, subprocess, sys

# Before numpy is imported.
for pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ[pool] = "1"

try:
    import numpy as np
    import scipy  # noqa: F401
except ImportError as error:
    print(f"skipped: {error} (pip install numpy scipy)")
    sys.exit(77)

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benches"))
# Rounds of each, ours and the other's by turns.
ROUNDS = 5
# A row that takes longer ends, and the table says so, s.
LIMIT = 300
# Frequencies of ours and of SciPy's may differ by this, relative.
SAME_FREQUENCY = 1e-6


class TooLong(RuntimeError):
    """A row's time is over."""


class Pliant:
    """The program. Each model is asked whether it is what its row says."""

    def __init__(self, path):
        self.command = [str(pathlib.Path(path).resolve())] if path else ["cargo", "run", "--release", "-q", "-p", "pliant_cli", "--"]

    def __call__(self, *arguments):
        done = subprocess.run([*self.command, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True)
        if done.returncode != 0:
            raise RuntimeError(f"pliant {arguments[0]}: {(done.stderr.strip() or 'failed').splitlines()[-1]}")
        return done.stdout

    def version(self):
        return self("--version").split()[-1]

    def bake(self, mesh, model, element, coordinates, material, young, poisson, density, *more):
        """What the bake tells. `material`: linear or neo-hookean."""
        told = json.loads(self("bake", mesh, "--element", element, "--modes", coordinates, "--material", material, "--young", young, "--poisson", poisson,
                               "--density", density, "--no-cache", "--threads", 1, *more, "-o", model, "--json"))
        info = json.loads(self("inspect", model, "--json"))
        want = {"element": element, "modes": coordinates, "material": None if material == "linear" else material}
        for key, value in want.items():
            if info[key] != value:
                raise RuntimeError(f"the model's {key} is {info[key]} where {value} was asked for")
        return told


def same_frequencies(ours, theirs):
    """The largest relative difference, or an error."""
    off = float(np.max(np.abs(np.asarray(theirs) / np.asarray(ours) - 1.0)))
    if not off <= SAME_FREQUENCY:
        raise RuntimeError(f"frequencies differ by {off:.1e} relative")
    return off


def write_vtk(path, points, tets):
    """A legacy ASCII file of tetrahedra, as PyBullet reads it."""
    lines = ["# vtk DataFile Version 2.0", "bar", "ASCII", "DATASET UNSTRUCTURED_GRID", f"POINTS {len(points)} double"]
    lines += [" ".join(map(repr, map(float, p))) for p in points]
    lines += [f"CELLS {len(tets)} {5 * len(tets)}"] + ["4 " + " ".join(map(str, t)) for t in tets]
    lines += [f"CELL_TYPES {len(tets)}"] + ["10"] * len(tets)
    path.write_text("\n".join(lines) + "\n")


def exudyn_settings(exudyn, steps, step):
    """For so many steps (s) on one thread. Its own advice for speed is that the Jacobian is kept as long as Newton converges."""
    settings = exudyn.SimulationSettings()
    settings.timeIntegration.numberOfSteps, settings.timeIntegration.endTime = steps, steps * step
    settings.timeIntegration.verboseMode, settings.solutionSettings.writeSolutionToFile = 0, False
    settings.timeIntegration.newton.useModifiedNewton = True
    settings.parallel.numberOfThreads = 1
    return settings


def within(seconds, work, folder):
    """What `work` returns, in a process of its own that ends when the time is over."""
    ours, its = multiprocessing.Pipe(False)

    def run():
        # Its own programs end with it. MuJoCo writes its log where it runs.
        os.setsid()
        os.chdir(folder)
        try:
            its.send((True, work()))
        except Exception as error:
            its.send((False, (str(error) or type(error).__name__).splitlines()[0]))

    child = multiprocessing.get_context("fork").Process(target=run)
    child.start()
    its.close()
    try:
        if not ours.poll(seconds):
            raise TooLong(f"not at its end after {seconds} s")
        done, told = ours.recv()
    except EOFError:
        child.join()
        raise RuntimeError(f"the program ended with {child.exitcode}") from None
    finally:
        try:
            os.killpg(child.pid, signal.SIGKILL)
        except ProcessLookupError:
            child.kill()
        child.join()
    if not done:
        raise RuntimeError(told)
    return told


def ratios(rounds):
    """Median, least and most of theirs over ours, of pairs of ours and theirs."""
    each = [theirs / ours for ours, theirs in rounds]
    return float(np.median(each)), min(each), max(each)


def figure(value):
    """Three digits, without a power of ten."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def span(values):
    """Least and most, with a unit after it, or the one value."""
    least, most = figure(min(values)), figure(max(values))
    return least if least == most else f"{least} to {most}"
