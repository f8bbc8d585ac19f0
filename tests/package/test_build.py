# SPDX-License-Identifier: GPL-3.0-or-later
"""What is inside the zips, and that the lists of wheels agree."""

from __future__ import annotations

import hashlib
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MANIFEST = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
SUMS = {entry["file"]: entry["sha256"] for entry in tomllib.loads((ROOT / "wheels.toml").read_text(encoding="utf-8"))["wheel"]}
# platform -> how the platform tags of its wheels begin and end
TAGS = {
    "linux-x64": ("manylinux", "_x86_64"),
    "windows-x64": ("win", "_amd64"),
    "macos-x64": ("macosx", "_x86_64"),
    "macos-arm64": ("macosx", "_arm64"),
}
SHIPPED = {"adjoint_gi", "solvers", "operators", "panels", "wheels"}
SHIPPED_FILES = {"__init__.py", "blender_manifest.toml", "LICENSE", "README.md", "CHANGELOG.md", "SECURITY.md"}


def belongs(wheel: str, platform: str) -> bool:
    tag = wheel.removesuffix(".whl").rsplit("-", 1)[-1]
    start, end = TAGS[platform]
    return tag.startswith(start) and tag.endswith(end)


def test_versions_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == MANIFEST["version"]
    for library in ("embreex", "xatlas"):
        (version,) = {name.split("-")[1] for name in SUMS if name.startswith(library + "-")}
        assert f"{library}=={version}" in project["dependencies"]


def test_manifest_lists_the_pinned_wheels():
    assert MANIFEST["wheels"] == [f"./wheels/{name}" for name in SUMS]


@pytest.mark.parametrize("platform", MANIFEST["platforms"])
@pytest.mark.parametrize("library", ["embreex", "openexr", "xatlas"])
@pytest.mark.parametrize("python", ["cp311", "cp313"])
def test_every_platform_and_python_has_each_library(platform, library, python):
    found = [name for name in SUMS if name.startswith(library + "-") and f"-{python}-{python}-" in name and belongs(name, platform)]
    assert len(found) == 1, found


@pytest.mark.parametrize("platform", MANIFEST["platforms"])
def test_zip_holds_the_product_and_nothing_else(zips, platform):
    path = zips / f"{MANIFEST['id']}-{MANIFEST['version']}-{platform.replace('-', '_')}.zip"
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if not name.endswith("/")]
        wheels = [name.removeprefix("wheels/") for name in names if name.startswith("wheels/")]
        assert sorted(wheels) == sorted(name for name in SUMS if belongs(name, platform))
        for name in wheels:
            assert hashlib.sha256(archive.read(f"wheels/{name}")).hexdigest() == SUMS[name]
        shipped = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert {name.split("/")[0] for name in names if "/" in name} <= SHIPPED
    assert {name for name in names if "/" not in name} <= SHIPPED_FILES
    assert {"__init__.py", "blender_manifest.toml", "LICENSE"} <= set(names)
    assert not [name for name in names if "__pycache__" in name or name.split("/")[-1].startswith(".")]
    # Every source file of the product is there.
    sources = {p.relative_to(ROOT).as_posix() for folder in SHIPPED - {"wheels"} for p in (ROOT / folder).rglob("*.py")}
    assert sources <= set(names)
    assert shipped["permissions"].keys() == {"files"}
    assert "build" not in shipped or "paths_exclude_pattern" in shipped["build"]
