# SPDX-License-Identifier: GPL-3.0-or-later
"""Cases of bad input and what must become of them, run through the command line inside Blender. Needs bpy."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.adjoint_gi.bridge.cli import main as cli
from adjgi.adjoint_gi.bridge.results.image import linked_image, read_pixels
from adjgi.adjoint_gi.bridge.results.links import ABOUT
from adjgi.tests.baking import fingerprint
from adjgi.tests.cycles_patch import add_light, diffuse_material

CUBE = (
    [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)],
    [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)],
)
SQUARE = ([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2, 3)])
EARLIER = "earlier.exr"


@dataclass(frozen=True)
class Case:
    """One bad scene.

    number   in section 7 of the verification page
    build    makes the scene; may use the folder it is given
    refused  object and words of the one sentence that ends the bake with exit code 2; None when the bake is done
    told     object and words of notices of a bake that is done
    options  more of the command line
    check    looks at the result of a bake that is done, see `Outcome`
    """

    number: int
    title: str
    build: Callable[[Path], None]
    refused: tuple[str, str] | None = None
    told: tuple[tuple[str, str], ...] = ()
    options: Sequence[str] = ()
    check: Callable[[Outcome], None] | None = None

    def __str__(self) -> str:
        return f"{self.number:02d} {self.title}"


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a bake that was done has left: its report and its folder."""

    report: dict
    folder: Path
    images: dict[str, np.ndarray] = field(default_factory=dict)

    def mean(self, name: str) -> np.ndarray:
        """(3,) mean irradiance of the covered texels of the object."""
        pixels = self.images[name]
        return pixels[pixels[..., 3] > 0][:, :3].mean(axis=0, dtype=np.float64)


def play(case: Case, folder: Path, capsys: object) -> None:
    """Bake the scene of `case` from the command line, and check everything that holds for all bad input."""
    # Step 1: the scene, and results of an earlier bake.
    case.build(folder)
    bpy.context.view_layer.update()
    out = folder / "out"
    out.mkdir()
    (out / EARLIER).write_bytes(b"an earlier result")
    earlier = bpy.data.images.new("earlier", 1, 1, float_buffer=True)
    earlier.pixels.foreach_set([0.25, 0.5, 0.75, 1.0])
    earlier[ABOUT] = "{}"
    before = fingerprint()

    # Step 2: pre-flight and bake.
    report = folder / "report.json"
    common = ["--resolution", "16", "--output", str(out), *case.options]
    if "--set" not in case.options:
        common += ["--set", "samples=4", "--set", "max_length=3"]
    capsys.readouterr()
    checked = cli.main(["check", *common], in_blender=True)
    preflight = capsys.readouterr().out
    code = cli.main(["bake", *common, "--report", str(report)], in_blender=True)
    said = capsys.readouterr().err

    # Step 3: nothing of the user's has changed, whatever the outcome; what was there is there.
    after = fingerprint()
    assert before == after, [(k, before.get(k), after.get(k)) for k in {**before, **after} if before.get(k) != after.get(k)]
    assert (out / EARLIER).read_bytes() == b"an earlier result"
    assert read_pixels(earlier).tolist() == [[[0.25, 0.5, 0.75, 1.0]]]
    assert "Traceback" not in said

    # Step 4: what was said.
    if case.refused is not None:
        assert code == 2, said
        _sentence(said, "error", *case.refused)
        assert sorted(p.name for p in out.iterdir()) == [EARLIER] and not report.exists()
        return
    assert code == 0 and checked == 0, (code, checked, said)
    for name, words in case.told:
        _sentence(said, "", name, words)
        _sentence(preflight, "", name, words)

    # Step 5: the result is made of numbers.
    outcome = Outcome(json.loads(report.read_text()), out)
    assert sorted(p.name for p in out.iterdir()) != [EARLIER]
    assert np.isfinite(outcome.report["mean"].get("irradiance", outcome.report["mean"].get("radiance"))).all()
    for obj in bpy.data.objects:
        image = linked_image(obj, "irradiance") if obj.type == "MESH" else None
        if image is not None:
            outcome.images[obj.name] = read_pixels(image)
            assert np.isfinite(outcome.images[obj.name]).all() and (outcome.images[obj.name][..., :3] >= 0).all()
    if case.check is not None:
        case.check(outcome)


def _sentence(text: str, severity: str, name: str, words: str) -> None:
    """One line that names the object, gives the reason and, if it is an error, what to do."""
    lines = [x for x in text.splitlines() if words in x and name in x.split(words)[0] and x.startswith(severity)]
    assert lines, f"no {severity or 'notice'} about {name!r} with {words!r} in:\n{text}"
    if severity == "error":
        assert len(lines) == 1 and lines[0].partition(words)[2].strip(" ."), f"no remedy in: {lines}"


# ---- pieces of scenes


def mesh(points: Sequence, faces: Sequence, name: str = "bad") -> bpy.types.Object:
    """A mesh object as it is: nothing is repaired."""
    data = bpy.data.meshes.new(name)
    data.from_pydata(list(points), [], list(faces))
    data.update()
    return put(data, name)


def put(data: bpy.types.ID | None, name: str) -> bpy.types.Object:
    """An object in the scene."""
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def good(light: bool = True) -> bpy.types.Object:
    """A floor that can be baked, and a sun."""
    floor = mesh(*SQUARE, name="Good")
    floor.location = (8, 0, 0)  # beside everything else
    floor.data.materials.append(diffuse_material("grey", 0.5))
    if light:
        add_light("SUN", energy=2.0, angle=0.0)
    return floor


def camera() -> bpy.types.Object:
    """A camera that looks down on the floor."""
    made = put(bpy.data.cameras.new("camera"), "camera")
    made.location = (0, 0, 5)
    bpy.context.scene.camera = made
    return made


def room(material: bpy.types.Material | None = None, name: str = "Room", inward: bool = True) -> bpy.types.Object:
    """A closed unit cube with normals to the inside, as in `demo`, and nothing else."""
    points, faces = CUBE
    made = mesh(points, [f[::-1] for f in faces] if inward else faces, name)
    made.data.materials.append(material or demo.material("wall", (0.5,) * 3, (0.3,) * 3))
    return made
