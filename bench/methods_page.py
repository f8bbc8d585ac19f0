"""Writes docs/methods.md from the registry, with a picture of one scene by every method.

    python bench/methods_page.py              pictures and page
    python bench/methods_page.py --page       the page alone, with the numbers of the last pictures

The scene is a Cornell box with a mirror and a glossy block and a ball of glass, so that what a method leaves out can be seen.
Needs no Blender.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
if "adjgi" not in sys.modules:
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])

from adjgi import solvers  # noqa: E402
from adjgi.adjoint_gi.core.images.png import write_png  # noqa: E402
from adjgi.adjoint_gi.core.method.registry import Solver, methods  # noqa: E402
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers  # noqa: E402
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material, SceneArrays  # noqa: E402
from adjgi.adjoint_gi.core.scene.builder import diffuse  # noqa: E402
from adjgi.adjoint_gi.core.scene.world import World  # noqa: E402
from adjgi.tests import scenes  # noqa: E402

SIZE = 160
PICTURES = ROOT / "docs" / "pictures" / "methods"
NUMBERS = ROOT / "docs" / "data" / "methods.json"
# What differs from the defaults, to keep each picture within a minute.
CHOSEN: dict[str, dict[str, object]] = {
    "local_illumination": {"ambient": 0.15},
    "whitted": {"ambient": 0.15},
    "distribution": {"samples": 16},
    "path_tracing": {"samples": 128},
    "irradiance_cache": {"accuracy": 0.3, "rays": 256},
    "multi_pass": {"samples": 32},
    "two_pass": {"samples": 16},
}


def glossy_cornell() -> SceneArrays:
    """The Cornell box with a mirror block, a glossy block and a glass ball."""
    b = scenes.cornell_builder(SIZE, SIZE)
    vertices, triangles = scenes.icosphere(3)
    glass = Material("Glass", (Lobe("glass", Color.of(1.0), 0.0, 1.5),))
    b.mesh("Ball", 0.11 * vertices + (0.28, 0.22, 0.111), triangles, glass, smooth_normals=vertices)
    scene = b.build()
    materials = list(scene.materials)
    gloss = Material("Glossy", (Lobe("diffuse", Color.of(0.3, 0.35, 0.7)), Lobe("specular", Color.of(1.0), 0.25, 1.5)))
    mirror = Material("Mirror", (Lobe("glossy", Color.of(0.9), 0.0),))
    for obj in scene.objects:
        own = scene.material[obj.first_triangle]
        if obj.name.startswith("Tall"):
            materials[own] = mirror
        if obj.name.startswith("Short"):
            materials[own] = gloss
    materials = [diffuse(m.name, 0.0, 15.0) if m.name == "Lamp" else m for m in materials]
    return dataclasses.replace(scene, materials=tuple(materials))


def picture(solver: Solver) -> dict[str, object]:
    """Solve for the camera and save the picture; returns what it took."""
    world = World(glossy_cornell())
    receivers = CameraReceivers(world)
    settings = solver.Settings(**CHOSEN.get(solver.spec.id, {}))
    memory = solver.memory(world, receivers, settings)
    began = time.perf_counter()
    for step in solver.solve(world, receivers, settings, np.random.default_rng(0)):
        last = step
    solution = last.solution()
    seconds = time.perf_counter() - began
    quantity = "radiance" if solution.measure == "radiance" else solution.measure
    image = solution.quantity(quantity).reshape(SIZE, SIZE, 3)
    if quantity != "radiance":
        image = image / max(float(image.max()), 1e-30)
    PICTURES.mkdir(parents=True, exist_ok=True)
    write_png(PICTURES / f"{solver.spec.id}.png", image.astype(np.float32), folder=PICTURES)
    return {
        "seconds": round(seconds, 1),
        "rays": solution.rays,
        "memory_mb": round(memory / 2**20),
        "settings": CHOSEN.get(solver.spec.id, {}),
    }


def section(solver: Solver, numbers: dict) -> list[str]:
    """The method's part of the page."""
    s = solver.spec
    nature = " and ".join(x.value for x in s.natures)
    strategy = " and ".join(x.value for x in s.strategies)
    out = [f"## {s.label}", "", f"`{s.id}` - {strategy}, {nature}. {s.authors}, {s.year}. Review, section {s.section}.", ""]
    out += [f"    {s.equation}", "", s.idea, ""]
    if s.id in numbers:
        n = numbers[s.id]
        changed = ", ".join(f"{k} {v}" for k, v in n["settings"].items())
        cost = f"{n['seconds']} s, {n['rays']:,} rays, {n['memory_mb']} MB by its own statement"
        cost += f" ({changed})." if changed else "."
        out += [f"![{s.label}](pictures/methods/{s.id}.png)", "", f"Cost of this picture, {SIZE} x {SIZE} on two cores: {cost}", ""]
    out += ["What it cannot do:", "", *(f"- {x}" for x in s.limits), ""]
    out += ["| setting | default | what it does |", "|---|---|---|"]
    for f in dataclasses.fields(solver.Settings):
        choices = f.metadata["choices"]
        text = f.metadata["help"] + (". One of: " + ", ".join(f"`{c[0]}` ({c[2]})" for c in choices) if choices else "")
        out.append(f"| `{f.name}` | {f.default} | {text} |")
    out += ["", f'Reference: {s.authors}, "{s.title}", {s.year}.', ""]
    return out


def page(numbers: dict) -> str:
    """The whole of docs/methods.md."""
    lines = [
        "# Methods",
        "",
        "Every method of the review in its place: which of the two adjoint equations it solves (gathering or shooting) and how",
        "(deterministic or nondeterministic). Written by `python bench/methods_page.py` from the registry. The pictures show one",
        "scene: a mirror block, a glossy block and a ball of glass, so that what a method leaves out can be seen.",
        "",
        "| method | strategy | nature | year | authors |",
        "|---|---|---|---|---|",
    ]
    for solver in methods():
        s = solver.spec
        strategy, nature = (", ".join(x.value for x in v) for v in (s.strategies, s.natures))
        lines.append(f"| [{s.label}](#{s.label.lower().replace(' ', '-')}) | {strategy} | {nature} | {s.year} | {s.authors} |")
    lines.append("")
    for solver in methods():
        lines += section(solver, numbers)
    return "\n".join(lines)


def main() -> None:
    """Make the pictures, unless only the page is asked for, and write the page."""
    solvers.load()
    numbers = json.loads(NUMBERS.read_text()) if NUMBERS.exists() else {}
    if "--page" not in sys.argv:
        only = [a for a in sys.argv[1:] if not a.startswith("-")]
        for solver in methods():
            if only and solver.spec.id not in only:
                continue
            numbers[solver.spec.id] = picture(solver)
            print(solver.spec.id, numbers[solver.spec.id], flush=True)
        NUMBERS.parent.mkdir(parents=True, exist_ok=True)
        NUMBERS.write_text(json.dumps(numbers, indent=1) + "\n")
    (ROOT / "docs" / "methods.md").write_text(page(numbers))


if __name__ == "__main__":
    main()
