# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of a bake: one dictionary that JSON can hold."""

from __future__ import annotations

import importlib.metadata
import importlib.resources
import platform
import tomllib
from dataclasses import asdict
from typing import Any

import bpy
import numpy as np

from .... import __package__ as base_package
from ...core.base.errors import Notice
from ...core.base.parallel import thread_count
from ...core.base.resources import peak_memory
from ...core.method.solution import Solution
from .bake import Bake

FORMAT = 1  # of the report


def of_bake(bake: Bake) -> dict[str, Any]:
    """Settings, seed, times, rays, energy balance, warnings, files, versions and flux numbers of a bake as far as it has come."""
    request, driver, solution = bake.request, bake.driver, bake.driver.solution()
    spec, scene = driver.solver.spec, driver.world.scene
    out = {
        "format": FORMAT,
        "method": {
            "id": spec.id,
            "label": spec.label,
            "strategies": [str(s) for s in spec.strategies],
            "natures": [str(n) for n in spec.natures],
            "authors": spec.authors,
            "year": spec.year,
        },
        "request": {k: v for k, v in request.as_dict().items() if k not in ("settings", "method")},
        "settings": request.settings.as_dict(),
        "seed": request.settings.seed,
        "state": driver.state,
        "partial": driver.state != "finished",
        "fraction": driver.fraction,
        "seconds": driver.seconds,
        "longest_step_seconds": driver.longest,
        "threads": thread_count(),
        "memory": {"estimated_bytes": driver.needed, "peak_bytes": peak_memory()},
        "scene": {
            "name": bake.scene_name,
            "file": bpy.data.filepath,
            "objects": len(scene.objects),
            "triangles": driver.world.triangle_count,
            "lights": len(scene.lights),
            "receivers": driver.receivers.count,
        },
        "lightmaps": [asdict(part) for part in bake.given],
        "written": list(bake.written),
        "files": list(bake.files),
        "notices": [as_dict(n) for n in bake.notices],
        "error": str(driver.error) if driver.error else None,
        "versions": versions(),
    }
    if solution is not None:
        out.update(of_solution(solution))
        known = {(n["object"], n["reason"]) for n in out["notices"]}
        out["notices"] += [as_dict(n) for n in solution.warnings if (n.object, n.reason) not in known]
    out["warnings"] = [n for n in out["notices"] if n["severity"] != "info"]
    return out


# Of the potential towards a camera the unit is m-2 or sr-1, as `core.flux.detectors` says.
UNITS = {"irradiance": "W m-2", "radiance": "W m-2 sr-1", "potential": "share"}


def of_solution(solution: Solution) -> dict[str, Any]:
    """Rays, energy balance, history and means of a result."""
    got = solution.weight > 0
    names = ("irradiance", "radiosity", "direct", "indirect", "emitted")
    names = names if solution.measure == "irradiance" else (solution.whole, "direct", "indirect", "emitted")
    means = {name: _mean(solution.quantity(name), got) for name in names}
    balance = None
    if solution.balance is not None:
        balance = {**asdict(solution.balance), "gap": solution.balance.gap, "unit": "W, sum of the three channels"}
    return {
        "rays": int(solution.rays),
        "rays_per_second": solution.rays / solution.seconds if solution.seconds else 0.0,
        "energy_balance": balance,
        "emitted_flux": solution.emitted_flux,
        "entering_flux": solution.entering_flux,
        "measure": solution.measure,
        "mean": means,
        "unit": UNITS[solution.measure],
        "without_samples": int((~got).sum()),
        "history": [[float(a), float(b)] for a, b in solution.history],
    }


def as_dict(notice: Notice) -> dict[str, str]:
    """A notice for JSON."""
    return {name: getattr(notice, name) for name in ("object", "reason", "remedy", "severity")}


def versions() -> dict[str, str]:
    """Versions of everything that a result depends on."""
    manifest = importlib.resources.files(base_package).joinpath("blender_manifest.toml")
    known = {"adjoint_gi": tomllib.loads(manifest.read_text(encoding="utf-8"))["version"]}
    known |= {
        "blender": bpy.app.version_string,
        "python": platform.python_version(),
        "system": platform.platform(),
        "numpy": np.__version__,
    }
    for name in ("embreex", "OpenEXR"):
        try:
            known[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # libraries put on the path without their metadata
            known[name] = "unknown"
    return known


def _mean(values: np.ndarray, got: np.ndarray) -> list[float]:
    return values[got].mean(axis=0, dtype=np.float64).tolist() if got.any() else [0.0, 0.0, 0.0]
