"""What a page tells about the run that made it: date, machine, load and versions."""

import importlib.metadata, os, pathlib, platform, re, subprocess, time

ROOT = pathlib.Path(__file__).resolve().parents[1]


def machine():
    """Date, processor, cores and kind of machine."""
    model = platform.processor() or platform.machine()
    try:
        told = re.search(r"^model name\s*:\s*(.+)$", pathlib.Path("/proc/cpuinfo").read_text(), re.M)
        model = told.group(1) if told else model
    except OSError:
        pass
    return f"{time.strftime('%Y-%m-%d', time.gmtime())}, {' '.join(model.split())}, {os.cpu_count()} cores, {platform.machine()}"


def load():
    """Processes that wanted a core, on average over the last minute."""
    return os.getloadavg()[0]


def installed(package):
    """The version of a package of Python."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def locked(crate):
    """The version of a crate that the programs here are built with."""
    told = re.search(rf'^name = "{crate}"\nversion = "(.+)"$', (ROOT / "Cargo.lock").read_text(), re.M)
    return told.group(1) if told else "not used"


def commit():
    """The commit that is checked out, and whether files differ from it; nothing without Git."""
    try:
        run = lambda *words: subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()
        changed = run("status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs")
        return f" (commit {run('rev-parse', '--short=10', 'HEAD')}{', with changes' if changed else ''})"
    except (OSError, subprocess.CalledProcessError):
        return ""
