"""Writes docs/methods.md from the registry, with a picture of one scene by every method.

    python bench/methods_page.py              pictures and page
    python bench/methods_page.py --page       the page alone, with the numbers of the last pictures
    python bench/methods_page.py --cost       the cost of an error alone, for the methods of COMPARED
    ... METHOD ...                            these methods alone

The scene is a Cornell box with a mirror and a glossy block and a ball of glass, so that what a method leaves out can be seen. What an error
costs is measured on elements of the plain Cornell box, against full-matrix radiosity with far more rays.
Needs no Blender.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import inspect
import json
import math
import sys
import textwrap
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
if "adjgi" not in sys.modules:
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])

from adjgi import solvers  # noqa: E402
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements  # noqa: E402
from adjgi.adjoint_gi.core.gallery.builder import diffuse  # noqa: E402
from adjgi.adjoint_gi.core.images.png import write_png  # noqa: E402
from adjgi.adjoint_gi.core.method.registry import Solver, method, methods  # noqa: E402
from adjgi.adjoint_gi.core.method.solution import Solution  # noqa: E402
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, Receivers  # noqa: E402
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material, SceneArrays  # noqa: E402
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
# Methods that shoot rays between diffuse elements, side by side: the rays that they are given for the cost of an error.
COMPARED = ("progressive_radiosity", "stochastic_jacobi")
RAYS = (250_000, 1_000_000, 4_000_000)
EDGE, REFERENCE_RAYS = 0.1, 16_384  # of the elements, and of each in the reference


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
    chosen = CHOSEN.get(solver.spec.id, {})
    memory = solver.memory(world, receivers, solver.Settings(**chosen))
    solution, seconds = solved(solver, world, receivers, chosen)
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
        "settings": chosen,
    }


def solved(solver: Solver, world: World, receivers: Receivers, options: dict[str, object]) -> tuple[Solution, float]:
    """The finished solution and the seconds it took."""
    settings = solver.Settings(**options)
    began = time.perf_counter()
    *_, last = solver.solve(world, receivers, settings, np.random.default_rng(settings.seed))
    return last.solution(), time.perf_counter() - began


def costs(names: list[str]) -> dict[str, list[dict[str, float]]]:
    """Rays cast, seconds and relative root mean square error of irradiance, for each method and number of `RAYS`."""
    world = World(scenes.cornell())
    receivers = ElementReceivers(Elements(world, EDGE))
    area = np.repeat(receivers.elements.area, 2)

    def light(solution: Solution) -> np.ndarray:
        return solution.quantity("irradiance").astype(float).sum(axis=1)

    exact = light(solved(method("matrix_radiosity"), world, receivers, {"rays": REFERENCE_RAYS})[0])
    out: dict[str, list[dict[str, float]]] = {name: [] for name in names}
    for name in names:
        for rays in RAYS:
            solution, seconds = solved(method(name), world, receivers, {"rays": rays, "max_edge": EDGE})
            error = math.sqrt((area @ (light(solution) - exact) ** 2) / (area @ exact**2))
            out[name].append({"rays": solution.rays, "seconds": round(seconds, 2), "error": float(f"{error:.3g}")})
    return out


def cost_table(numbers: dict) -> list[str]:
    """What an error costs each of `COMPARED`: the error falls with the root of the cost, so the last columns hardly change."""
    out = [
        "## Cost of an error",
        "",
        "The two methods that shoot rays between diffuse elements, side by side: progressive radiosity shoots from the elements with the",
        "most unshot light, along even sets of rays; stochastic Jacobi from all at once, along random rays. Cornell box, elements of",
        f"{EDGE:g} m; error of the irradiance, relative to full-matrix radiosity with {REFERENCE_RAYS:,} rays an element.",
    ]
    out += [
        "",
        "| method | rays | seconds | error | million rays x (error in %)^2 | seconds x (error in %)^2 |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    for name in COMPARED:
        for row in numbers.get(name, {}).get("cost", ()):
            squared = (100 * row["error"]) ** 2
            cells = (f"{row['rays']:,}", f"{row['seconds']:.2f}", f"{row['error']:.2%}".replace("%", " %"))
            last = (f"{row['rays'] / 1e6 * squared:.2f}", f"{row['seconds'] * squared:.2f}")
            out.append("| " + " | ".join((method(name).spec.label, *cells, *last)) + " |")
    return [*out, ""]


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
    out += shown(solver)
    out += ["What it cannot do:", "", *(f"- {x}" for x in s.limits), ""]
    out += ["| setting | default | what it does |", "|---|---|---|"]
    for f in dataclasses.fields(solver.Settings):
        choices = f.metadata["choices"]
        text = f.metadata["help"] + (". One of: " + ", ".join(f"`{c[0]}` ({c[2]})" for c in choices) if choices else "")
        out.append(f"| `{f.name}` | {f.default} | {text} |")
    out += ["", f'Reference: {s.authors}, "{s.title}", {s.year}.', ""]
    return out


def shown(solver: Solver) -> list[str]:
    """`solve` of a method, and each function of its module whose head names an equation, as they stand in the file."""
    path = Path(inspect.getsourcefile(type(solver)))
    text = path.read_text(encoding="utf-8")
    functions = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef)]
    chosen = [n for n in functions if n.name == "solve" or "Eq. " in (ast.get_docstring(n) or "").split("\n\n")[0]]
    chosen.sort(key=lambda n: (n.name != "solve", n.lineno))
    blocks = [textwrap.dedent("\n".join(text.splitlines()[n.lineno - 1 : n.end_lineno])) for n in chosen]
    return [f"From [`solvers/{path.name}`](../solvers/{path.name}):", "", "```python", "\n\n".join(blocks), "```", ""]


def page(numbers: dict) -> str:
    """The whole of docs/methods.md."""
    lines = [
        "# Methods",
        "",
        "The methods of the review and one more, in their place: which of the two adjoint equations each solves (gathering or shooting)",
        "and how (deterministic or nondeterministic). Written by `python bench/methods_page.py` from the registry. The pictures show one",
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
    lines += cost_table(numbers)
    return "\n".join(lines)


def main() -> None:
    """Make the pictures, unless only the page is asked for, and write the page."""
    solvers.load()
    numbers = json.loads(NUMBERS.read_text()) if NUMBERS.exists() else {}
    if "--page" not in sys.argv:
        only = [a for a in sys.argv[1:] if not a.startswith("-")] or [solver.spec.id for solver in methods()]
        for name in only if "--cost" not in sys.argv else ():
            numbers[name] = numbers.get(name, {}) | picture(method(name))
            print(name, numbers[name], flush=True)
        for name, rows in costs([name for name in COMPARED if name in only]).items():
            numbers[name]["cost"] = rows
            print(name, rows, flush=True)
        NUMBERS.parent.mkdir(parents=True, exist_ok=True)
        NUMBERS.write_text(json.dumps(numbers, indent=1) + "\n")
    (ROOT / "docs" / "methods.md").write_text(page(numbers))


if __name__ == "__main__":
    main()
