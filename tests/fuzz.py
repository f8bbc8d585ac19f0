# SPDX-License-Identifier: GPL-3.0-or-later
"""Random scenes through `check` and `bake`, each with a seed and a time limit:

    python tests/fuzz.py --seeds 0:500 [--seconds 30] [--python PYTHON]        (a Python that has the bpy wheel)

A seed passes when nothing raises or hangs, `check` and `bake` agree, and the user's data are as before: after a refused bake at once, after
a done one when its results are cleared. The scenes are built by `tests/random_scenes.py`. Exit code 1 names the seeds that failed;
`--seeds 17:18 --keep FILE` saves the scene of one.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import hashlib
import importlib.util
import io
import os
import queue
import random
import re
import subprocess
import sys
import tempfile
import threading
import traceback
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
BUILT, DONE = "built", "seed"  # first words of the lines about a scene that is there, and about a seed that was tried
METHODS = {  # settings that make a bake of 16 texels a side cheap
    "path_tracing": {"samples": 1, "max_length": 3},
    "local_illumination": {"light_points": 1},
    "whitted": {"light_points": 1, "depth": 2},
    "distribution": {"samples": 1, "max_length": 3},
    "particle_tracing": {"particles": 2000, "max_length": 4},
    "matrix_radiosity": {"rays": 16, "max_edge": 20.0, "light_samples": 1, "max_iterations": 5},
    "progressive_radiosity": {"rays": 2000, "max_edge": 20.0, "light_samples": 1, "max_shots": 20},
    "stochastic_jacobi": {"rays": 2000, "max_edge": 20.0, "light_samples": 1},
}


# ---- the process that looks after the others


def main() -> int:
    """Try the seeds in processes of their own, so that a crash or a hang costs one seed; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0:60", metavar="FIRST:END", help="which seeds (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=30.0, help="limit for one seed (default: %(default)s)")
    parser.add_argument("--python", default=sys.executable, help="the Python that has bpy (default: this one)")
    parser.add_argument("--keep", metavar="FILE", help="save the scene of the first seed as this .blend file and try nothing")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    first, end = (int(x) for x in options.seeds.split(":"))
    if options.worker:
        return work(first, end, options.keep)
    failed: dict[int, str] = {}
    skipped: list[int] = []
    while first < end:
        first = watch(first, end, options, failed, skipped)
    if skipped:
        print(f"Blender itself crashed or took too long while it built seeds {skipped}")
    for seed, why in sorted(failed.items()):
        print(f"FAILED seed {seed}: {why}")
    print(f"{len(failed)} seeds failed" if failed else "all seeds passed")
    return 1 if failed else 0


def watch(first: int, end: int, options: argparse.Namespace, failed: dict[int, str], skipped: list[int]) -> int:
    """Run one process from seed `first` on until it ends, or is stopped for one that takes too long; returns the seed to go on with."""
    command = [options.python, __file__, "--worker", "--seeds", f"{first}:{end}"]
    command += ["--keep", options.keep] if options.keep else []
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
    lines: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        for line in process.stdout:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    seed, built, said, limit = first, False, [], options.seconds + 30.0  # Blender has to start
    while True:
        try:
            line = lines.get(timeout=limit)
        except queue.Empty:
            process.kill()
            if not built:
                skipped.append(seed)
                return seed + 1
            failed[seed] = f"takes more than {options.seconds:g} s: {''.join(said[-3:])}"
            return seed + 1
        limit = options.seconds
        if line is None:
            if process.wait() < 0 and not built:
                skipped.append(seed)
                return seed + 1
            if process.returncode != 0 or seed < end:
                failed[seed] = f"ended the process with code {process.returncode}: {''.join(said[-12:])}"
                return seed + 1
            return end
        words = line.split(maxsplit=2)
        if words[:2] == [BUILT, str(seed)]:
            built = True
        elif len(words) == 3 and words[0] == DONE and words[1].isdigit():
            seed, built, said = int(words[1]) + 1, False, []
            if words[2].strip() != "passed":
                failed[int(words[1])] = words[2].strip().encode().decode("unicode_escape")
        else:
            said.append(line)


# ---- the process with Blender


def load() -> Any:
    """The extension as the package `adjgi`, registered, as tests have it."""
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules["adjgi"] = module
    import bpy  # noqa: F401  isort: split

    spec.loader.exec_module(module)
    module.register()
    return module


def work(first: int, end: int, keep: str | None) -> int:
    """Try seeds one after the other and print a line about each."""
    faulthandler.enable()
    load()
    import bpy
    from adjgi.tests.random_scenes import RandomScene

    out = os.fdopen(os.dup(1), "w")
    for seed in range(first, end):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        RandomScene(seed).build()
        print(BUILT, seed, file=out, flush=True)
        if keep:
            bpy.ops.wm.save_as_mainfile(filepath=str(Path(keep).absolute()), copy=True)
            print(f"saved {keep}")
            os._exit(0)
        try:
            with tempfile.TemporaryDirectory(prefix="adjoint_gi_fuzz_") as folder:
                Trial(seed, Path(folder)).run()
            result = "passed"
        except AssertionError as error:
            result = str(error)
        except Exception:
            result = traceback.format_exc()
        print(DONE, seed, result.encode("unicode_escape").decode(), file=out, flush=True)
    out.flush()
    os._exit(0)  # an interpreter with Blender inside may hang while it is taken apart


class Trial:
    """One scene through `check`, `bake`, Show Result and Clear Results. Raises AssertionError with what is wrong."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.rng = random.Random(-1 - seed)
        self.folder = folder
        self.instances = random.Random(seed).random() < 0.5  # apart from the others, so that each seed still tries what it tried
        self.target = self.rng.choice(("texture", "texture", "texture", "attribute", "attribute", "render"))

    def run(self) -> None:
        """All of it."""
        from adjgi.adjoint_gi.bridge.cli.open import leave_edit_mode

        # Step 1: what the command line does by itself, before the user's data are looked at.
        leave_edit_mode()
        self._changed("check", before := user_data())

        # Step 2: check and bake, which must agree.
        common, own = self.arguments()
        checked, asked, _ = self.command(["check", *common])
        self._changed("check", before)
        baked, _, said = self.command(["bake", *common, *own])
        assert checked in (0, 2) and baked in (0, 2), f"check ended with {checked}, bake with {baked}: {asked[-600:]} {said[-900:]}"
        assert checked == baked, f"check ended with {checked} and bake with {baked}: {lines(asked, 'error')} {lines(said, 'error')}"
        if baked == 2:
            assert lines(asked, "error") == lines(said, "error"), f"check: {lines(asked, 'error')}; bake: {lines(said, 'error')}"
            self._changed("a refused bake", before)
            return
        missing = lines(asked, "warning") - lines(said, "warning")
        assert not missing, f"bake does not say what check says: {missing}; it says {lines(said, 'warning')}"

        # Step 3: show and take away.
        self.show()
        clear()
        self._changed("bake and Clear Results", before)

    def arguments(self) -> tuple[list[str], list[str]]:
        """Arguments of both commands, and those that only `bake` has."""
        import bpy

        rng = self.rng
        method = rng.choice(("path_tracing", "path_tracing", *METHODS))
        common = ["--method", method, "--target", self.target, "--resolution", "16", "--subsamples", "1", "--size", "8x6", "--threads", "1"]
        for key, value in METHODS[method].items():
            common += ["--set", f"{key}={value}"]
        if self.target == "texture" and rng.random() < 0.3:
            common.append("--atlas")
        if self.target == "attribute":
            common += ["--domain", rng.choice(("POINT", "CORNER"))]
            common += ["--new-object"] if rng.random() < 0.2 else []
        if self.target != "render" and self.instances:
            common.append("--instances")
        meshes = [o.name for o in bpy.data.objects if o.type == "MESH"]
        if self.target != "render" and meshes and rng.random() < 0.2:
            common += ["--objects", *rng.sample(meshes, min(2, len(meshes)))]
        if self.target == "attribute":
            return common, ["--save-blend", str(self.folder / "out.blend")]
        return [*common, "--output", str(self.folder)], []

    def command(self, arguments: list[str]) -> tuple[int, str, str]:
        """Exit code, standard output and standard error of a command."""
        from adjgi.adjoint_gi.bridge.cli import main as cli

        out, error = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
            code = cli.main(arguments, in_blender=True)
        text = out.getvalue() + error.getvalue()
        assert "Traceback" not in text, f"{arguments[0]}: {text[text.index('Traceback') :][-1500:]}"
        return code, out.getvalue(), error.getvalue()

    def show(self) -> None:
        """Show Result, for what objects hold."""
        import bpy
        from adjgi.adjoint_gi.bridge.results import show
        from adjgi.adjoint_gi.core.base.errors import AdjointError

        record = bpy.context.scene.adjoint_gi.result
        record.target, record.quantity = self.target, "irradiance"
        if self.target != "render":
            with contextlib.suppress(AdjointError):  # a mesh without slots that is linked or in edit mode is refused, with a reason
                show.show(bpy.context.scene, bpy.context.view_layer)

    def _changed(self, what: str, before: dict[str, str]) -> None:
        """Raise AssertionError where the user's data are not as they were."""
        after = user_data()
        other = [k for k in {**before, **after} if before.get(k) != after.get(k)]
        assert not other, f"{what} changed {[(k, differing(before.get(k, ''), after.get(k, ''))) for k in other[:3]]}"


def lines(text: str, severity: str) -> set[str]:
    """The notices of a severity; objects of one sentence may be grouped in another way, so only the sentence counts."""
    found = [line for line in text.splitlines() if line.startswith(severity + ": ")]
    return {re.sub(r"[\d.,]+ [kMG]B are free", "some are free", line.split(": ", 2)[-1]) for line in found}


def differing(a: str, b: str) -> tuple[str, str]:
    """Where two long texts differ."""
    k = next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
    return a[max(0, k - 60) : k + 80], b[max(0, k - 60) : k + 80]


def clear() -> None:
    """Clear Results with Remove Baked Data."""
    import bpy
    from adjgi.adjoint_gi.bridge.results import show
    from adjgi.adjoint_gi.bridge.results.remove import remove_results

    show.restore(bpy.context.scene)
    remove_results(bpy.context.scene)


# ---- the user's data

KINDS = ("objects", "meshes", "materials", "lights", "cameras", "worlds", "images", "node_groups", "collections", "curves", "metaballs",
         "particles", "scenes", "textures", "actions", "armatures", "lattices", "volumes", "hair_curves", "pointclouds")  # fmt: skip
VOLATILE = {
    *("rna_type", "session_uid", "is_evaluated", "is_updated", "is_updated_data", "users", "tag", "preview", "original", "id_data"),
    *("bindcode", "has_data", "is_dirty", "is_embedded_data", "internal_links", "bound_box", "is_runtime_data", "adjoint_gi", "is_valid"),
    *("is_active", "depsgraph", "frame_duration", "execution_time"),
}
MESH_ITEMS = {
    *("vertices", "edges", "loops", "polygons", "loop_triangles", "loop_triangle_polygons", "corner_normals", "vertex_normals"),
    *("polygon_normals", "attributes", "color_attributes", "uv_layers", "vertex_colors", "skin_vertices"),
}
DEEP = {  # what belongs to its owner, and is the user's
    *("modifiers", "material_slots", "node_tree", "nodes", "links", "inputs", "outputs", "particle_systems", "dof", "color_ramp"),
    *("elements", "colorspace_settings", "interface", "items_tree", "view_layers", "image_user", "render", "data", "splines", "points"),
}


def user_data() -> dict[str, str]:
    """What the user's datablocks hold, by kind and name: equal when nothing has changed. Properties with a name of ours are not his."""
    import bpy

    bpy.context.view_layer.update()
    out = {}
    for kind in KINDS:
        for block in getattr(bpy.data, kind, ()):
            text = described(block, 0)
            if kind == "meshes":
                text += layers(block)
            if kind == "objects":
                text += f" selected {block.name in bpy.context.view_layer.objects and (block.select_get(), block.hide_get(), block.mode)}"
            if kind == "images" and block.source == "GENERATED":
                text += hashlib.sha256(repr(block.pixels[:]).encode()).hexdigest()
            out[f"{kind} {block.name_full}"] = text
    out["active"] = str(getattr(bpy.context.view_layer.objects.active, "name", None))
    return out


def described(owner: Any, depth: int) -> str:
    """Properties of a datablock and of what belongs to it, as text."""
    import bpy

    known = owner.bl_rna.properties  # Blender 4.2 lists what extensions register among custom properties, once it was read
    own = [k for k in (owner.keys() if depth == 0 else ()) if not k.startswith("adjoint_gi") and k not in known]
    parts = [f"{k}={owner[k]!r}" for k in own]
    for p in owner.bl_rna.properties:
        name = p.identifier
        if name in VOLATILE or name in MESH_ITEMS:
            continue
        if p.type == "POINTER":
            value = getattr(owner, name)
            if isinstance(value, bpy.types.ID) and not value.is_embedded_data:
                parts.append(f"{name}->{value.name_full}")
            elif value is not None and name in DEEP and depth < 6:
                parts.append(f"{name}=({described(value, depth + 1)})")
        elif p.type == "COLLECTION":
            if isinstance(p.fixed_type, bpy.types.ID) or name in ("objects", "children", "materials"):
                parts.append(f"{name}={[getattr(x, 'name_full', None) for x in getattr(owner, name)]}")
            elif name in DEEP and depth < 6:
                parts.append(f"{name}=[{'; '.join(described(x, depth + 1) for x in list(getattr(owner, name))[:64])}]")
        else:
            value = getattr(owner, name)
            parts.append(f"{name}={tuple(value) if getattr(p, 'is_array', False) else value!r}")
    return ", ".join(parts)


def layers(mesh: Any) -> str:
    """The arrays of a mesh."""
    import numpy as np

    out = [f" active {mesh.uv_layers.active_index} render {[x.active_render for x in mesh.uv_layers]}"]
    fields = {
        "FLOAT_COLOR": ("color", 4),
        "BYTE_COLOR": ("color", 4),
        "FLOAT_VECTOR": ("vector", 3),
        "FLOAT2": ("vector", 2),
        "INT32_2D": ("value", 2),
    }
    for attribute in mesh.attributes:
        field, width = fields.get(attribute.data_type, ("value", 1))
        values = np.zeros(len(attribute.data) * width, np.float32 if attribute.data_type.startswith(("FLOAT", "BYTE")) else np.int32)
        if attribute.data_type not in ("STRING", "QUATERNION", "FLOAT4X4"):
            attribute.data.foreach_get(field, values)
        if attribute.name == "material_index" and not values.any():
            continue  # as good as none
        out.append(f"{attribute.name} {attribute.domain} {attribute.data_type} {hashlib.sha256(values.tobytes()).hexdigest()[:12]}")
    return "; ".join(out)


if __name__ == "__main__":
    sys.exit(main())
