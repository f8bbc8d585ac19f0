# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the environments of this repository and runs its commands in them. Needs only Python 3.11 or 3.13 itself.

    python dev.py demo [arguments]      bake the demonstration scene into out/demo (arguments go to `adjoint-gi demo`)
    python dev.py test [arguments]      ruff, then all tests in the bpy wheel (arguments go to pytest, and ruff is left out)
    python dev.py fuzz [arguments]      random scenes through check and bake (arguments go to tests/fuzz.py)
    python dev.py build                 fetch and check the wheels, validate, build the extension's zips into dist/
    python dev.py matrix [VERSION ...]  the tests in several Blender versions (default: all of MATRIX)
    python dev.py blender PROGRAM [...] install the built zip into an empty folder of a real Blender and run the tests in it
    python dev.py packages [PYTHON]     the folder with pytest and the libraries for tests/run.py inside a real Blender

Everything it makes is kept and used again: `.venv` here, the rest under ADJOINT_GI_CACHE (default: the user's cache folder).
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent
TOOLS = ("pytest==9.2.0", "pytest-xdist==3.8.0", "ruff==0.17.6")
PIP = ("-q", "--disable-pip-version-check", "--no-input")
SECONDS = 3600  # limit of one test run
# Whole suites run in several processes: many tests keep one core busy only. More than four would want more memory than they save time.
PROCESSES = min(4, os.cpu_count() or 1)
SIDE_BY_SIDE = ("-n", str(PROCESSES), "--dist", "worksteal") if PROCESSES > 1 else ()


@dataclass(frozen=True)
class Blender:
    """One bpy wheel, the Python it was made for, and which tests run in it by `dev.py matrix`."""

    version: str
    python: tuple[int, int]
    extra: tuple[str, ...]
    runs: tuple[tuple[str, ...], ...]  # each (extension mode, pytest arguments ...)


MATRIX = {
    # The real Blender 4.2 ships numpy 1.24; the wheel alone would take the newest.
    "4.2": Blender("4.2.23", (3, 11), ("numpy==1.24.4",), (("1", "tests/blender", "tests/package"),)),
    "5.0": Blender("5.0.1", (3, 11), (), (("1", "tests"),)),
    # Core and methods once more under numpy 2, this time as plain Python.
    "5.2": Blender("5.2.3", (3, 13), (), (("1", "tests/blender", "tests/package"), ("", "tests/core", "tests/methods"))),
}
DEFAULT = {(3, 11): "5.0", (3, 13): "5.2"}  # the Blender of .venv, by the Python that runs this file


class DevError(Exception):
    """Something the developer has to mend; the text says how."""


def say(text: str) -> None:
    """Print a line that stands out between the output of other programs."""
    print(f"== {text}", flush=True)


def run(command: Iterable[str | Path], seconds: float = SECONDS, output: Path | None = None, **extra: str) -> int:
    """Run a command from the repository root with `extra` added to the environment; returns its exit code, 124 when time ran out.

    What it prints goes to the file `output`, if one is named.
    """
    words = [str(word) for word in command]
    say(" ".join(words))
    start = time.monotonic()
    try:
        with nullcontext() if output is None else output.open("wb") as file:
            options = {"cwd": ROOT, "env": os.environ | extra, "timeout": seconds, "stdin": subprocess.DEVNULL}
            code = subprocess.run(words, stdout=file, stderr=file and subprocess.STDOUT, **options).returncode
    except subprocess.TimeoutExpired:
        code = 124
    say(f"{'stopped' if code == 124 else f'exit {code}'} after {time.monotonic() - start:.1f} s")
    return code


def cache_folder() -> Path:
    """Where wheels and environments are kept between runs and between checkouts."""
    if os.environ.get("ADJOINT_GI_CACHE"):
        return Path(os.environ["ADJOINT_GI_CACHE"]).expanduser().resolve()
    if sys.platform == "win32":
        return Path(os.environ["LOCALAPPDATA"]) / "adjoint-gi"
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches/adjoint-gi"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "adjoint-gi"


def packages_folder(python: tuple[int, int]) -> Path:
    """The folder of `dev.py packages` for one Python version."""
    return cache_folder() / f"packages-py{python[0]}{python[1]}"


def project() -> dict:
    """The table [project] of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


# Environments


def find_python(version: tuple[int, int]) -> str:
    """A Python of this version: the running one, one on the path, or one of pyenv's; raises DevError when there is none."""
    name = f"python{version[0]}.{version[1]}"
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    candidates = [sys.executable, shutil.which(name), *sorted(pyenv.glob(f"{version[0]}.{version[1]}.*/bin/python"))]
    for candidate in filter(None, candidates):
        # A name on the path may be a shim that leads nowhere: ask it.
        probe = [str(candidate), "-c", "import sys; print(*sys.version_info[:2])"]
        answer = subprocess.run(probe, capture_output=True, text=True, stdin=subprocess.DEVNULL)
        if answer.returncode == 0 and answer.stdout.split() == [str(version[0]), str(version[1])]:
            return str(candidate)
    raise DevError(f"no Python {version[0]}.{version[1]} was found: install it, so that `{name}` runs")


def venv_python(folder: Path) -> Path:
    """The interpreter inside a virtual environment."""
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def stamped(folder: Path, text: str) -> bool:
    """Whether `folder` was completed for just these requirements."""
    stamp = folder / "requirements.stamp"
    return stamp.is_file() and stamp.read_text(encoding="utf-8") == text


def environment(folder: Path, blender: Blender) -> Path:
    """Make (or reuse) a virtual environment with bpy, the tools and this checkout; returns its Python. Raises DevError."""
    requirements = (f"bpy=={blender.version}", *blender.extra, *TOOLS)
    stamp = "\n".join([str(ROOT), *requirements, (ROOT / "pyproject.toml").read_text(encoding="utf-8")])
    python = venv_python(folder)
    if stamped(folder, stamp):
        return python
    base = find_python(blender.python)
    say(f"making {folder} with {' '.join(requirements)}")
    if run([base, "-m", "venv", "--clear", folder]):
        raise DevError(f"{base} could not make a virtual environment (on Debian: apt-get install python3-venv)")
    # Editable: the environment always runs the code of this checkout.
    if run([python, "-m", "pip", "install", *PIP, *requirements, "--editable", ROOT]):
        raise DevError("pip could not install the requirements: see its message above")
    if run([python, "-c", "import bpy, embreex, OpenEXR, xatlas"], 300):
        raise DevError(
            "the installed libraries do not load: see the message above. On Debian, bpy needs the packages "
            "libegl1 libgl1 libsm6 libxext6 libxfixes3 libxi6 libxkbcommon0 libxrender1 libxxf86vm1"
        )
    (folder / "requirements.stamp").write_text(stamp, encoding="utf-8")
    return python


def main_environment() -> Path:
    """The environment `.venv`, for the Python that runs this file; raises DevError where bpy has no wheel for it."""
    version = sys.version_info[:2]
    if version not in DEFAULT:
        raise DevError(f"bpy has no wheel for Python {version[0]}.{version[1]}: run this file by Python 3.11 or 3.13")
    return environment(ROOT / ".venv", MATRIX[DEFAULT[version]])


def packages(version: tuple[int, int]) -> Path:
    """Fill the folder that `tests/run.py` adds to a real Blender's path: pytest, the project's libraries, numpy of that Blender's age."""
    folder = packages_folder(version)
    wanted = (TOOLS[0], *(d for d in project()["dependencies"] if not d.startswith("numpy")))
    stamp = "\n".join(wanted)
    if stamped(folder, stamp):
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    # Any Python's pip can do this for another version, as long as it takes wheels only. Blender brings its own numpy.
    target = ["--target", folder, "--python-version", f"{version[0]}.{version[1]}", "--only-binary", ":all:"]
    pip = [sys.executable, "-m", "pip", "install", *PIP, *target]
    if run([*pip, wanted[0]]) or run([*pip, "--no-deps", *wanted[1:]]):
        raise DevError("pip could not fetch the packages: see its message above")
    (folder / "requirements.stamp").write_text(stamp, encoding="utf-8")
    return folder


# The extension's zips


def fetch_wheels() -> None:
    """Put every wheel of wheels.toml into wheels/, from the cache or from the package index; raises DevError on a wrong sum."""
    cache = cache_folder() / "wheels"
    cache.mkdir(parents=True, exist_ok=True)
    (ROOT / "wheels").mkdir(exist_ok=True)
    listed = {entry["file"]: entry["sha256"] for entry in tomllib.loads((ROOT / "wheels.toml").read_text(encoding="utf-8"))["wheel"]}
    for stray in set(ROOT.joinpath("wheels").glob("*.whl")) - {ROOT / "wheels" / name for name in listed}:
        stray.unlink()  # of an older list
    for name, sha256 in listed.items():
        kept = cache / name
        if not kept.is_file():
            download(name, cache)
        found = hashlib.sha256(kept.read_bytes()).hexdigest()
        if found != sha256:
            kept.unlink()
            raise DevError(f"{name} has SHA-256 {found}, but wheels.toml says {sha256}: it was deleted; do not use it")
        shutil.copyfile(kept, ROOT / "wheels" / name)
    say(f"{len(listed)} wheels, sums right")


def download(name: str, folder: Path) -> None:
    """Fetch the one wheel called `name` by pip, which knows the package index of this machine; raises DevError."""
    project_name, version, tag, _, systems = name.removesuffix(".whl").split("-")
    command = [sys.executable, "-m", "pip", "download", *PIP, "--no-deps", "--only-binary", ":all:"]
    command += ["--python-version", f"{tag[2]}.{tag[3:]}", "--platform", systems.split(".")[-1], "--dest", str(folder)]
    if run([*command, f"{project_name}=={version}"], 900) or not (folder / name).is_file():
        raise DevError(f"pip did not bring {name}: see its message above, or correct wheels.toml")


def build(python: Path, dist: Path) -> list[Path]:
    """Validate the sources, build one zip a platform into the folder `dist`, validate each; returns their paths. Raises DevError.

    `python` has the bpy wheel.
    """
    fetch_wheels()
    # Blender's own builder is a plain script inside the wheel; it needs no window and no Blender process.
    where = "import importlib.util; print(importlib.util.find_spec('bpy').origin)"
    wheel = Path(subprocess.run([str(python), "-c", where], capture_output=True, text=True, check=True).stdout.strip()).parent
    tool = [python, next(wheel.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))]
    shutil.rmtree(dist, ignore_errors=True)
    dist.mkdir(parents=True)
    if run([*tool, "validate", ROOT], 300):
        raise DevError("blender_manifest.toml is not valid: see the message above")
    if run([*tool, "build", "--split-platforms", "--source-dir", ROOT, "--output-dir", dist], 600):
        raise DevError("the zips could not be built: see the message above")
    zips = sorted(dist.glob("*.zip"))
    for path in zips:
        if run([*tool, "validate", path], 300):
            raise DevError(f"{path.name} is not valid: see the message above")
    return zips


def own_zip(dist: Path) -> Path:
    """The zip in `dist` that fits the machine this runs on; raises DevError when it was not built."""
    system = {"win32": "windows", "darwin": "macos"}.get(sys.platform, "linux")
    machine = {"arm64": "arm64", "aarch64": "arm64"}.get(platform.machine().lower(), "x64")
    found = sorted(dist.glob(f"*-{system}_{machine}.zip"))
    if len(found) != 1:
        raise DevError(f"{dist} holds {len(found)} zips for {system}-{machine}: run `python dev.py build`")
    return found[0]


# Commands


def test(arguments: list[str]) -> int:
    """Check the style of the whole repository, then run pytest in the extension mode; with arguments only what they name."""
    python = main_environment()
    codes = [] if arguments else [run([python, "-m", "ruff", *words, "."], 300) for words in (("check",), ("format", "--check"))]
    codes.append(run([python, "tests/run.py", *(arguments or SIDE_BY_SIDE)], ADJOINT_GI_EXTENSION="1"))
    if any(codes[:-1]):
        say("FAILED: ruff, see its message above")
    return max(codes)


def matrix(names: list[str]) -> int:
    """Run each version's tests, one at a time; returns 1 if any of them failed."""
    results = {}
    for name in names or MATRIX:
        if name not in MATRIX:
            raise DevError(f"{name} is not in the matrix: choose of {', '.join(MATRIX)}")
        blender = MATRIX[name]
        python = environment(cache_folder() / f"bpy-{blender.version}", blender)
        for mode, *arguments in blender.runs:
            label = f"Blender {name} {'as extension' if mode else 'plain'}: {' '.join(arguments)}"
            say(label)
            results[label] = run([python, "tests/run.py", *arguments, *SIDE_BY_SIDE], ADJOINT_GI_EXTENSION=mode)
    for label, code in results.items():
        say(f"{'passed' if code == 0 else f'FAILED ({code})'}  {label}")
    return int(any(results.values()))


def in_blender(program: str, arguments: list[str]) -> int:
    """Install the built zip into an empty user folder of a real Blender and run pytest inside it; returns the exit code."""
    ask = "import sys, importlib.util as u; print('PYTHON', *sys.version_info[:2], 'numpy' if u.find_spec('numpy') else 'bare')"
    command = [program, "-b", "--factory-startup", "--python-expr", ask]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=600, stdin=subprocess.DEVNULL)
    words = next((line.split() for line in answer.stdout.splitlines() if line.startswith("PYTHON ")), None)
    if words is None:
        raise DevError(f"{program} did not run: {answer.stderr.strip() or answer.stdout.strip()}")
    if words[3] == "bare":
        raise DevError(f"{program} has no numpy, which Blender itself ships: install it (on Debian: apt-get install python3-numpy)")
    folder = packages((int(words[1]), int(words[2])))
    package = own_zip(ROOT / "dist")
    with tempfile.TemporaryDirectory(prefix="adjoint_gi_user_") as user:
        extra = {"BLENDER_USER_RESOURCES": user, "ADJOINT_GI_TEST_PACKAGES": str(folder), "ADJOINT_GI_DIST": str(package.parent)}
        install = ["--command", "extension", "install-file", "-r", "user_default", "--enable", package]
        if run([program, "--factory-startup", *install], 600, **extra):
            raise DevError(f"{package.name} could not be installed: see the message above")
        start = [program, "-b", "--factory-startup", "--python-exit-code", "1", "--python", "tests/run.py", "--"]
        extra["ADJOINT_GI_EXTENSION"] = "installed"
        shares = [arguments] if arguments else shares_of(PROCESSES, "blender", "package")
        return run_together([[*start, *share] for share in shares], extra, "BLENDER_USER_RESOURCES")


def shares_of(count: int, *folders: str) -> list[list[str]]:
    """The test files of `folders`, dealt out to `count` runs, the longest files first."""
    files = [path for folder in folders for path in ROOT.joinpath("tests", folder).glob("test_*.py")]
    files.sort(key=lambda path: (-path.stat().st_size, path.name))
    return [[str(path.relative_to(ROOT)) for path in files[k::count]] for k in range(count)]


def run_together(commands: list[list[str | Path]], extra: dict[str, str], own: str) -> int:
    """Run commands side by side, each with a copy of the folder that `own` of the environment `extra` names; returns the worst exit code.

    What the first prints is seen at once; what the others print, at the end.
    """
    with tempfile.TemporaryDirectory(prefix="adjoint_gi_runs_") as folder, ThreadPoolExecutor(len(commands)) as pool:
        started = []
        for k, command in enumerate(commands):
            copy, output = Path(folder, f"folder{k}"), Path(folder, f"output{k}.txt") if k else None
            shutil.copytree(extra[own], copy, symlinks=True)
            started.append((output, pool.submit(run, command, output=output, **extra | {own: str(copy)})))
        codes = []
        for output, job in started:
            codes.append(job.result())
            if output is not None:
                print(output.read_text(encoding="utf-8", errors="replace"), flush=True)
    return max(codes, key=abs)


def main(arguments: list[str]) -> int:
    """Carry out one command; returns the exit code."""
    command, rest = (arguments[0], arguments[1:]) if arguments else ("help", [])
    if command == "demo":
        python = main_environment()
        return run([python.with_name("adjoint-gi"), "demo", "--output", "out/demo", *rest])
    if command == "test":
        return test(rest)
    if command == "fuzz":
        return run([main_environment(), "tests/fuzz.py", *rest])
    if command == "build":
        for path in build(main_environment(), ROOT / "dist"):
            print(path.relative_to(ROOT))
        return 0
    if command == "matrix":
        return matrix(rest)
    if command == "blender" and rest:
        return in_blender(rest[0], rest[1:])
    if command == "packages":
        version = tuple(int(n) for n in rest[0].split(".")) if rest else sys.version_info[:2]
        print(packages(version))
        return 0
    print(__doc__)
    return 0 if command in ("help", "-h", "--help") else 2


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except DevError as error:
        sys.exit(f"dev.py: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
