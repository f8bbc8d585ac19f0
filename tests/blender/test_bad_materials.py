# SPDX-License-Identifier: GPL-3.0-or-later
"""Bad materials, lights and UV maps: numbers 29 to 41 of the verification page's hostile inputs, each through the command line, as a table.

Every case also checks that the user's data are as before, that earlier results are kept, and that results are numbers; see
`tests/hostile.py`. What extraction does in detail stands in test_extract_materials.py, test_extract_colors.py and test_extract_lights.py.
"""

from __future__ import annotations

import struct
import zlib

import bpy
import numpy as np
import pytest
from adjgi.tests.cycles_patch import add_light, shader_material
from adjgi.tests.hostile import SQUARE, Case, mesh, play, room

NAN = float("nan")
SUN = 2.0
GREY = 0.8  # what Blender takes for no material, and what takes the place of what is not understood


def sheet(*materials, lamp=True):
    """A sheet with a UV map and these materials, below a sun."""
    made = mesh(*SQUARE)
    made.data.uv_layers.new(name="UVMap")
    for material in materials:
        made.data.materials.append(material)
    if lamp:
        add_light("SUN", energy=SUN, angle=0.0)
    return made


def of(kind, **values):
    """A builder: the sheet with a material "m" of one shader."""
    return lambda _: sheet(shader_material("m", kind, **values))


def diffuse_of(node_kind, prepare):
    """A builder: the sheet with a diffuse material whose colour comes from a node; `prepare(node, folder)` fills it."""

    def build(folder):
        material = shader_material("m", "ShaderNodeBsdfDiffuse")
        tree = material.node_tree
        node = tree.nodes.new(node_kind)
        prepare(node, folder)
        diffuse = next(n for n in tree.nodes if n.bl_idname == "ShaderNodeBsdfDiffuse")
        if node.outputs:
            tree.links.new(node.outputs[0], diffuse.inputs["Color"])
        sheet(material)

    return build


def textured(make):
    """A builder: the sheet with the image that `make(folder)` gives as its colour."""

    def prepare(node, folder):
        node.image = make(folder)

    return diffuse_of("ShaderNodeTexImage", prepare)


def png(path, width, height, rows):
    """An RGB picture whose header promises this size; `rows` may hold less."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))
    return path


def white(folder, name="white.png"):
    """A white picture of one pixel on disk."""
    return bpy.data.images.load(str(png(folder / name, 1, 1, b"\0\xff\xff\xff")))


def missing(folder):
    image = bpy.data.images.new("missing", 4, 4)
    image.source, image.filepath = "FILE", str(folder / "nothing.png")
    return image


def packed(folder):
    image = white(folder, "packed.png")
    image.pack()
    (folder / "packed.png").unlink()
    return image


def generated(_):
    image = bpy.data.images.new("generated", 2, 2)
    image.pixels.foreach_set(np.ones(16, np.float32))
    return image


def tiles(_):
    image = bpy.data.images.new("tiles", 2, 2, tiled=True)
    image.pixels.foreach_set(np.ones(16, np.float32))
    return image


def sequence(folder):
    image = white(folder, "frame_0001.png")
    image.source = "SEQUENCE"
    return image


def corrupt(folder):
    (folder / "bad.exr").write_bytes(b"\x76\x2f\x31\x01" + b"garbage" * 9)
    return bpy.data.images.load(str(folder / "bad.exr"))


def huge(folder):
    return bpy.data.images.load(str(png(folder / "huge.png", 30_000, 30_000, b"")))


def deep(node, _):
    """A group in a group in a group, 200 times."""
    inner = None
    for i in range(200):
        tree = bpy.data.node_groups.new(f"group {i}", "ShaderNodeTree")
        tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
        made = tree.nodes.new("ShaderNodeRGB" if inner is None else "ShaderNodeGroup")
        if inner is not None:
            made.node_tree = inner
        tree.links.new(made.outputs[0], tree.nodes.new("NodeGroupOutput").inputs[0])
        inner = tree
    node.node_tree = inner


def in_itself(node, _):
    """A group that is put into itself: Blender leaves the inner node without a group."""
    tree = bpy.data.node_groups.new("loop", "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    inner = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = tree
    inner.node_tree = tree
    if inner.outputs:
        tree.links.new(inner.outputs[0], tree.nodes.new("NodeGroupOutput").inputs[0])


def closed(_):
    """A closed room that absorbs nothing and emits radiosity 1 from every wall."""
    white_lamp = shader_material("perfect", "ShaderNodeBsdfDiffuse", Color=(1, 1, 1, 1))
    nodes = white_lamp.node_tree.nodes
    emission, add = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeAddShader")
    emission.inputs["Strength"].default_value = 1 / np.pi
    link = white_lamp.node_tree.links.new
    link(nodes["Diffuse BSDF"].outputs[0], add.inputs[0])
    link(emission.outputs[0], add.inputs[1])
    link(add.outputs[0], nodes["Material Output"].inputs["Surface"])
    room(white_lamp)


def lamp(kind, **values):
    def build(_):
        sheet()
        add_light(kind, **values).name = "bad lamp"

    return build


def without_ies_file(_):
    sheet()
    made = add_light("POINT", energy=10.0)
    made.name = "bad lamp"
    made.data.use_nodes = True
    tree = made.data.node_tree
    profile = tree.nodes.new("ShaderNodeTexIES")
    profile.mode, profile.filepath = "EXTERNAL", "//nothing.ies"
    emission = next(n for n in tree.nodes if n.type == "EMISSION")
    tree.links.new(profile.outputs[0], emission.inputs["Strength"])


def no_uv(_):
    mesh(*SQUARE)
    add_light("SUN", energy=SUN, angle=0.0)


# ---- what results must be


def albedo(*expected):
    """The sheet reflects this share of the light of the sun, which reaches it whole."""

    def check(outcome):
        means = outcome.report["mean"]
        np.testing.assert_allclose(means["irradiance"], SUN, rtol=1e-4)
        np.testing.assert_allclose(
            np.array(means["radiosity"]) - means["emitted"], SUN * np.broadcast_to(expected, 3), rtol=1e-3, atol=1e-6
        )

    return check


def emits(expected):
    """The sheet emits this radiosity."""

    def check(outcome):
        np.testing.assert_allclose(outcome.report["mean"]["emitted"], expected, rtol=1e-5)

    return check


def three_lengths(outcome):
    """Every wall receives radiosity 1 from each of the path lengths 1, 2 and 3."""
    np.testing.assert_allclose(outcome.report["mean"]["irradiance"], 3.0, rtol=0.02)


def sun_only(outcome):
    np.testing.assert_allclose(outcome.mean("bad"), SUN, rtol=1e-4)


def black(outcome):
    assert not any(outcome.report["mean"]["irradiance"])


CLAMPED = ('Material "m"', "it is clamped")
LOST = "its place is taken by the grey 0.8"
MATRIX = ("--method", "matrix_radiosity", "--set", "rays=64", "--set", "max_edge=0.5")
BOUNDED = ("--set", "max_length=3", "--set", "samples=16", "--set", "roulette=no")
RED = (2.0, 0.5, -1.0, 1.0)

CASES = [
    Case(29, "no material", lambda _: sheet(), check=albedo(GREY)),
    Case(29, "empty slot", lambda _: sheet(None), check=albedo(GREY)),
    Case(30, "albedo over 1 and under 0", of("ShaderNodeBsdfDiffuse", Color=RED), told=(CLAMPED,), check=albedo(1.0, 0.5, 0.0)),
    Case(31, "albedo 1 in a closed room, matrix", closed, ("Material perfect", "reflects all light (albedo 1)"), options=MATRIX),
    Case(31, "albedo 1 in a closed room, paths", closed, options=BOUNDED, check=three_lengths),
    Case(
        32, "emission that is no number", of("ShaderNodeEmission", Strength=NAN), told=(('Material "m"', "not a number"),), check=emits(0)
    ),
    Case(32, "negative emission", of("ShaderNodeEmission", Strength=-3.0), told=(CLAMPED,), check=emits(0)),
    Case(32, "emission of 1e30", of("ShaderNodeEmission", Strength=1e30), told=(CLAMPED,), check=emits(np.pi * 1e9)),
    Case(33, "missing image", textured(missing), told=(('Image "missing"', LOST),), check=albedo(GREY)),
    Case(34, "packed image", textured(packed), check=albedo(1.0)),
    Case(34, "generated image", textured(generated), check=albedo(1.0)),
    Case(34, "UDIM tiles", textured(tiles), told=(('Image "tiles"', "has UDIM tiles; only the first one is used"),)),
    Case(
        34,
        "sequence",
        textured(sequence),
        told=(('Image "frame_0001.png"', "is an image sequence; its frame 1 is used"),),
        check=albedo(1.0),
    ),
    Case(35, "corrupt EXR", textured(corrupt), told=(('Image "bad.exr"', LOST),), check=albedo(GREY)),
    Case(36, "image of 30,000 x 30,000", textured(huge), told=(('Image "huge.png"', LOST),), check=albedo(GREY)),
    Case(
        37, "node that is not understood", diffuse_of("ShaderNodeTexNoise", lambda *_: None), told=(('Material "m"', "is not understood"),)
    ),
    Case(37, "shader that is not understood", of("ShaderNodeBsdfHair"), told=(('Material "m"', "is not computed; an ideal diffuser"),)),
    Case(38, "groups 200 deep", diffuse_of("ShaderNodeGroup", deep), told=(('Material "m"', "nested deeper"),)),
    Case(38, "group in itself", diffuse_of("ShaderNodeGroup", in_itself)),
    Case(39, "lamp of size zero", lamp("AREA", energy=5.0, size=0.0), told=(("bad lamp", "area light of size zero"),), check=sun_only),
    Case(39, "lamp without power", lamp("POINT", energy=0.0), told=(("bad lamp", "is a light without power"),), check=sun_only),
    Case(39, "lamp without its IES file", without_ies_file, told=(("bad lamp", "is not understood; the default value"),)),
    Case(40, "no light", lambda _: sheet(lamp=False), told=(("Scene", "nothing emits light; the result is black"),), check=black),
    Case(41, "no UV map", no_uv, told=(("bad", "has no lightmap UV layer yet; one is made"),), check=sun_only),
    Case(41, "no UV map, one asked for", no_uv, ("bad", 'has no UV layer "Mine" (layers: none)'), options=("--uv-layer", "Mine")),
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_bad_materials(case, tmp_path, capsys):
    play(case, tmp_path, capsys)
