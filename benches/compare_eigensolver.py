"""The eigensolver beside SciPy's, on the same matrices, in one run, one thread each.

    pip install numpy scipy
    cargo build --release -p pliant_cli
    python benches/compare_eigensolver.py [--pliant target/release/pliant] [--modes 60]
        [--cells 24,8,8 ...]

For each bar: `pliant bake --threads 1 --no-cache --export-matrices`, then
`scipy.sparse.linalg.eigsh(K, k, M, sigma, tol=1e-8)` on the exported K and M. Its own default would
be machine precision, and Pliant's iteration ends at 4e-9, so that times would not be those of equal
accuracy. Printed: degrees of freedom, seconds of Pliant's factorization and modes, seconds of eigsh
(its factorization in it), both as medians of rounds by turns, the ratio (median, least and most of
the rounds), and the largest relative difference of the eigenvalues. Leaves with 1 when one differs
by more than 1e-8.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"

try:
    import numpy as np
    from scipy.io import mmread
    from scipy.sparse.linalg import eigsh
except ImportError as error:
    print(f"skipped: {error} (pip install numpy scipy)")
    sys.exit(77)


def measure(pliant, element, cells, modes, rounds):
    with tempfile.TemporaryDirectory() as folder:
        mesh, model = os.path.join(folder, "bar.msh"), os.path.join(folder, "bar.modal")
        x, y, z = (int(n) for n in cells.split(","))
        size = f"1,{y / x},{z / x}"
        bar = [pliant, "mesh", "bar", "--cells", cells, "--size", size, "-o", mesh]
        subprocess.run(bar, check=True, stdout=subprocess.DEVNULL)
        bake = [pliant, "bake", mesh, "--element", element, "--modes", str(modes)]
        # Bakes have a material for large strains unless told otherwise, and no modes beyond it.
        bake += ["--material", "linear"]
        bake += ["--poisson", "0.3", "--anchor", "x<0.001", "--threads", "1", "--no-cache"]
        bake += ["--export-matrices", folder, "-o", model, "--json"]
        want = {"element": element, "modes": modes, "material": None}
        # By turns: other programs slow now the one, now the other.
        pairs = []
        for _ in range(rounds):
            told = json.loads(subprocess.run(bake, check=True, capture_output=True).stdout)
            for key, value in want.items():
                if told[key] != value:
                    raise RuntimeError(f"the model's {key} is {told[key]}, not {value}")
            ours = told["seconds"]["factor"] + told["seconds"]["modes"]
            k = mmread(os.path.join(folder, "K.mtx")).tocsc()
            m = mmread(os.path.join(folder, "M.mtx")).tocsc()
            start = time.perf_counter()
            found = eigsh(k, k=modes, M=m, sigma=0.0, tol=1e-8, return_eigenvectors=True)[0]
            pairs.append((ours, time.perf_counter() - start))
        mine = (2 * np.pi * np.array(told["frequencies_hz"])) ** 2
        differ = float(np.max(np.abs(mine / np.sort(found) - 1)))
        ours, theirs = np.median(pairs, axis=0)
        ratios = [its / own for own, its in pairs]
        times = f"{ours:>9.3f} {theirs:>9.3f} {np.median(ratios):>6.2f}"
        times += f" {min(ratios):>6.2f} {max(ratios):>6.2f}"
        print(f"{element:>6} {cells:>10} {k.shape[0]:>7} {times} {differ:>9.1e}", flush=True)
        return differ


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pliant", default="target/release/pliant")
    parser.add_argument("--modes", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--element", action="append", choices=["tet4", "tet10"])
    parser.add_argument("--cells", action="append")
    args = parser.parse_args()
    if not os.path.isfile(args.pliant):
        print(f"skipped: no program at {args.pliant} (cargo build --release -p pliant_cli)")
        return 77
    print("element      cells     dof  pliant s   scipy s  ratio  least   most    differ")
    worst = 0.0
    for element in args.element or ["tet4", "tet10"]:
        sizes = ["30,10,10", "45,15,15"] if element == "tet4" else ["16,5,5", "27,9,9"]
        for cells in args.cells or sizes:
            worst = max(worst, measure(args.pliant, element, cells, args.modes, args.rounds))
    return 0 if worst <= 1e-8 else 1


if __name__ == "__main__":
    sys.exit(main())
