# SPDX-License-Identifier: GPL-3.0-or-later
"""What `check` says of scenes, and the report of a bake by every method, line by line; see `tests/approval.py`.

The floor of the reports has 2 x 2 m and an albedo of 0.5, below a sun that gives 2, 1 and 0.5 W m-2. So its irradiance is just that and its
radiosity half of it; 4 m2 x 3.5 W m-2 = 14 W enter, and of them 7 W are absorbed and 7 W escape. A sun is counted over the scene's bounds.
"""

from __future__ import annotations

import io
import math
import re
from types import SimpleNamespace

import bpy
import pytest
from adjgi.adjoint_gi.bridge.baking import preflight
from adjgi.adjoint_gi.bridge.baking.bake import Bake, rehearse
from adjgi.adjoint_gi.bridge.baking.report import of_bake
from adjgi.adjoint_gi.bridge.cli import bake as cli_bake
from adjgi.adjoint_gi.bridge.cli import progress
from adjgi.adjoint_gi.core.base.errors import Notice
from adjgi.adjoint_gi.core.method import clock, driver, registry
from adjgi.tests import baking
from adjgi.tests.approval import approve, flat
from adjgi.tests.blender import fakes
from adjgi.tests.counting import FakeTime
from adjgi.tests.cycles_patch import add_light, diffuse_material, shader_material
from adjgi.tests.hostile import CUBE, SQUARE, mesh, put

QUICK = {"samples": 4, "particles": 4096, "max_edge": 0.5, "rays": 1024, "tolerance": 0.01, "caustic_particles": 0}
MACHINE = re.compile(r"versions|memory|threads|seconds|longest|rays|scene.file|settings|history|.*particles|request.output")
SMALL = re.compile(r"[0-9.]+e-[0-9]+")  # residuals are of rounding errors in the end
SIZE = re.compile(r"about [0-9.]+ [kMG]B of memory")  # it depends on the number of threads


def floor():
    made = mesh(*SQUARE, name="Floor")
    made.data.materials.append(diffuse_material("Grey", 0.5))
    add_light("SUN", energy=2.0, angle=0.0, color=(1.0, 0.5, 0.25))
    bpy.context.view_layer.update()
    return made


@pytest.fixture(autouse=True)
def memory(monkeypatch):
    monkeypatch.setattr(preflight, "available_memory", lambda: 8 * 10**12)


def report(made, digits=6):
    """What is told of a bake, without what belongs to the machine."""
    lines = [SIZE.sub("about SIZE of memory", line) for line in flat(of_bake(made), digits=digits)]
    return [line for line in lines if not MACHINE.match(line)]


def test_reports_are_told_as_approved(registered):
    """In full of the first method; of the others, what differs. Particle tracing has noise: 1.98 instead of 2, of which two digits stay."""
    told, known = [], []
    floor()
    for m in registry.methods():
        values = {k: v for k, v in QUICK.items() if k in m.Settings.__dataclass_fields__}
        quantity = "irradiance"
        if m.spec.answers == "potential":
            quantity, values = "potential", values | {"receivers": "objects", "objects": "Floor"}
        made = Bake(bpy.context, baking.request(m.spec.id, values=values, resolution=8, quantity=quantity, objects=("Floor",)))
        made.driver.run()
        lines = report(made, 2 if m.spec.id == "particle_tracing" else 6)
        told += ["", f"# {m.spec.label}", *(line for line in lines if line not in known)]
        known = known or lines
    approve("reports", told[1:])


def box():
    """A closed box of 2 m with albedo 0.25 that emits 4, 2 and 1 W m-2 on both sides, with a camera of 6 x 4 pixels in it.

    In red: direct light is what is emitted, 4, and with paths of up to 3 segments indirect light 4 / 4 + 4 / 16 = 1.25 (elements have
    noise in the third digit); the radiosity is 4 + 5.25 / 4 = 5.31. Emitted are 2 x 24 m2 x 7 W m-2 = 336 W; half of them escape and
    168 W enter. Of these 3/4 + 3/16 + 3/64 are absorbed, 165.4 W, and 2.6 W are left, 1.6 %. The radiance that is seen is by pi 4
    emitted (1.27), 4 / 4 direct (0.318) and 1.25 / 4 indirect (0.0995). There are 12 triangles, 6 x 4 x 4 = 96 elements of 0.5 m and 24
    corners of the cube.
    """
    material = shader_material("Glow", "ShaderNodeBsdfDiffuse", Color=(0.25, 0.25, 0.25, 1.0))
    tree = material.node_tree
    add, glow = tree.nodes.new("ShaderNodeAddShader"), tree.nodes.new("ShaderNodeEmission")
    glow.inputs["Color"].default_value, glow.inputs["Strength"].default_value = (1.0, 0.5, 0.25, 1.0), 4 / math.pi
    end = tree.nodes["Material Output"].inputs["Surface"]
    tree.links.new(end.links[0].from_socket, add.inputs[0])
    tree.links.new(glow.outputs[0], add.inputs[1])
    tree.links.new(add.outputs[0], end)
    made = mesh([tuple(2.0 * c - 1 for c in p) for p in CUBE[0]], [f[::-1] for f in CUBE[1]], name="Box")
    made.data.materials.append(material)
    put(bpy.data.cameras.new("Camera"), "Camera")
    bpy.context.scene.camera = bpy.data.objects["Camera"]
    bpy.context.view_layer.update()


def test_reports_of_emitters_and_pictures_are_told_as_approved(registered, tmp_path):
    told, known = [], []
    box()
    exact = {"max_edge": 0.5, "rays": 64, "max_length": 3, "tolerance": 1e-9}
    walks = {"samples": 16, "max_length": 3, "roulette": False}
    for words, method, values, more in (
        ("elements", "matrix_radiosity", exact, {"resolution": 16}),
        ("corners", "path_tracing", walks, {"target": "attribute"}),
        ("faces of elements", "matrix_radiosity", exact, {"target": "attribute", "new_object": True, "quantity": "radiosity"}),
        ("pixels", "path_tracing", walks, {"target": "render", "output": str(tmp_path), "width": 6, "height": 4}),
    ):
        made = Bake(bpy.context, baking.request(method, values=values, **more))
        made.driver.run()
        lines = report(made, 3)
        told += ["", f"# {words}", *(line for line in lines if line not in known)]
        known = known or lines
    approve("box", told[1:])


def test_steps_are_told_as_approved(registered, monkeypatch):
    """What is told while each method works in the box, with a step wherever one may be: of texts alike but for digits, the first and last.

    The box has 24 elements of 1 m, so 48 sides that are shot: 168 W meet the box of 336 W, and 42 W, 12.5 %, are reflected.
    """
    box()
    told = []
    monkeypatch.setattr(clock, "PAUSE", -1.0)
    for m in registry.methods():
        values = {k: v for k, v in QUICK.items() if k in m.Settings.__dataclass_fields__}
        values |= {k: v for k, v in {"max_edge": 1.0, "rays": 64, "max_length": 3}.items() if k in m.Settings.__dataclass_fields__}
        potential = m.spec.answers == "potential"
        values |= {"receivers": "objects", "objects": "Box"} if potential else {}
        quantity = "potential" if potential else "irradiance"
        made = Bake(bpy.context, baking.request(m.spec.id, values=values, resolution=8, quantity=quantity))
        steps = {}

        def note(job, steps=steps):
            told_now = f"{job.fraction:.3f} {SMALL.sub('RESIDUAL', job.text)}"
            found = steps.setdefault(re.sub("[0-9.,]+", "#", told_now), [])
            found[1:] = [told_now]

        made.driver.run(note)
        told += ["", f"# {m.spec.label}", *(line for found in steps.values() for line in dict.fromkeys(found))]
        told += [f"{n.severity}: {n}" for n in made.driver.solution().warnings if n.object != "Path Length"]
    approve("steps", told[1:])


def house():
    """A bit of all that a check has words for.

    Six ropes are curves without faces, two tubes curves with 8 triangles each. Three places make instances of a chair and a table,
    "lone" one of a chair, all of 2 triangles, as floor (4 m2) and wall (2 m2) have: 2 + 2 + 16 + 14 = 34. Three boxes are left out of
    renders.

    Of 20 texels a metre images are thought to be filled by 0.6: 20 (4 / 0.6)^(1/2) = 51.6 and 36.5, in fours 52 and 40 a side, 4304 in
    all. Floor and tube have 4 + 16 corners. Elements of 0.5 m are 16 for each of 8 squares, 8 of the wall, 2 for each of 8 faces of
    tubes: 152, times 4.
    """
    floor()
    wall = mesh([(-1, 1, 0), (1, 1, 0), (1, 1, 1), (-1, 1, 1)], [(0, 1, 2, 3)], "Wall")
    wall.data.uv_layers.new(name="Mine")
    wall.data.materials.append(shader_material("Gloss", "ShaderNodeBsdfPrincipled", Roughness=0.25))
    wall.visible_diffuse = wall.visible_glossy = False
    for k in range(6):
        put(bpy.data.curves.new(f"Rope {k}", "CURVE"), f"Rope {k}")
    for k in range(2):
        tube = bpy.data.curves.new(f"Tube {k}", "CURVE")
        tube.dimensions, tube.bevel_depth, tube.bevel_resolution, tube.resolution_u = "3D", 0.125, 0, 1
        spline = tube.splines.new("POLY")
        spline.points.add(1)
        spline.points[1].co = (0, 0, 1, 1)
        put(tube, f"Tube {k}").location = (4 + k, 0, 0)
    props, lone = bpy.data.collections.new("props"), bpy.data.collections.new("one")
    for name, collections in (("chair", (props, lone)), ("table", (props,))):
        obj = mesh(*SQUARE, name=name)
        bpy.context.scene.collection.objects.unlink(obj)
        for collection in collections:
            collection.objects.link(obj)
    for k, collection in enumerate((props, props, props, lone)):
        maker = put(None, f"place {k}" if collection is props else "lone")
        maker.instance_type, maker.instance_collection, maker.location = "COLLECTION", collection, (3.0 * k, 8, 0)
    for k in range(3):
        mesh(*CUBE, name=f"Box {k}").hide_render = True
    add_light("POINT", location=(0, 0, 3)).data.cycles.max_bounces = 3
    bpy.context.scene.cycles.max_bounces, bpy.context.scene.cycles.sample_clamp_indirect = 7, 2.5
    bpy.context.view_layer.update()


def test_what_checks_say_is_as_approved(registered, monkeypatch, tmp_path):
    """In full of the first request; of the others, what differs."""
    told, known = [], []
    house()
    for words, method, values, more in (
        ("lightmaps", "path_tracing", {"samples": 4}, {"resolution": 32}),
        ("an atlas of instances", "path_tracing", {"samples": 4}, {"resolution": 64, "atlas": True, "instances": True}),
        ("20 texels a metre", "path_tracing", {"samples": 4}, {"resolution": 512, "texels_per_metre": 20.0, "objects": ("Floor", "Wall")}),
        ("a named layer that one lacks", "path_tracing", {}, {"uv_layer": "Mine"}),
        ("what cannot be baked", "path_tracing", {}, {"objects": ("Floor", "Nowhere", "Box 1", "lamp", "Rope 2")}),
        ("corners of two", "path_tracing", {"samples": 4}, {"target": "attribute", "objects": ("Floor", "Tube 0")}),
        ("elements of one", "matrix_radiosity", {"max_edge": 0.5}, {"target": "attribute", "new_object": True, "objects": ("Floor",)}),
        ("a picture without a camera", "path_tracing", {}, {"target": "render"}),
        ("numbers out of bounds", "path_tracing", {}, {"resolution": 0, "subsamples": 300, "quantity": "potential"}),
    ):
        found = rehearse(bpy.context, baking.request(method, values=values, **more))
        lines = [SIZE.sub("about SIZE of memory", f"{n.severity}: {n}") for n in found]
        told += ["", f"# {words}", *(line for line in lines if line not in known)]
        known = known or lines
    monkeypatch.setattr(preflight, "available_memory", lambda: 123_456)
    found = rehearse(bpy.context, baking.request(resolution=32))
    told += ["", "# little memory", *(SIZE.sub("about SIZE of memory", str(n)) for n in found if n.severity == "error")]
    monkeypatch.setattr(preflight, "QUICK", 10)
    found = preflight.preflight(bpy.context, baking.request(resolution=32))
    told += ["", "# a big scene", *(SIZE.sub("about SIZE of memory", str(n)) for n in found if n.object == "Scene")]
    twice = SimpleNamespace(objects=[SimpleNamespace(instance=True, maker="rows", source=source) for source in ("pot", "pot", "cup")])
    told += ["", "# three instances of two", *map(str, preflight._instances(twice, baking.request()))]
    monkeypatch.setattr(cli_bake, "say", told.append)
    for name in ("request_of", "open_scene"):
        monkeypatch.setattr(cli_bake, name, lambda _: None)
    told += ["", "# counted"]
    for kinds in (("info",), ("error", "warning"), ("warning", "error", "warning", "info", "warning", "error")):
        monkeypatch.setattr(
            cli_bake, "rehearse", lambda *_, kinds=kinds: [Notice("It", f"is the {n}.", "", k) for n, k in enumerate(kinds)]
        )
        told.append(f"exit code {cli_bake.check(None)}")
    approve("check", told[1:])


class Clock(FakeTime):
    """8.125 seconds a sleep, none for a look."""

    def sleep(self, seconds):
        self.now += 8.125

    def monotonic(self):
        return self.now


def test_times_are_told_as_approved(registered, monkeypatch):
    """A method of eight steps of 8.125 s, stopped after three of them: 24.375 s and 3/8 are done, and 5/3 of it, 40.6 s, are left."""
    told = []
    now = Clock()
    for module in (driver, progress, fakes):
        monkeypatch.setattr(module, "time", now)
    monkeypatch.setattr(cli_bake, "peak_memory", lambda: None)
    with fakes.fake_method(registered):
        fakes.square().data.materials.clear()
        made = Bake(bpy.context, baking.request("fake", values={"steps": 8}, resolution=4))
        printed = io.StringIO()
        said = progress.Progress("Fake", printed)
        said.terminal = True

        def step(job):
            said(job)
            told.append(f"{job.fraction:g}, {job.text}, {job.seconds} s, {job.seconds_left:.4g} s left, {job.rays:,} rays")
            if "3" in job.text[:6]:
                job._stop.set()

        for words in ("stopped", "finished"):
            made.driver.run(step)
            report = flat(of_bake(made), digits=4)
            names = (
                "state",
                "partial",
                "fraction",
                "seconds",
                "longest",
                "rays",
                "energy",
                "emitted",
                "entering",
                "mean",
                "written",
                "warnings",
            )
            told += ["", f"# {words}", *(line for line in report if line.startswith(names)), cli_bake.summary(made)]
        said.end()
    told += ["", "# printed", *printed.getvalue().split("\r")]
    told += [f"{s:g} s: {progress.seconds_text(s)}" for s in (0.04, 59.94, 59.96, 61.0, 125.4, 3599.6, 7384.0)]
    approve("times", told)
