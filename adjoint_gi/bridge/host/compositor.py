# SPDX-License-Identifier: GPL-3.0-or-later
"""Images denoised by the Denoise node of Blender's compositor (Open Image Denoise), in a scene that is there for that long only.

The compositor is reached by rendering a scene alone, and a scene that shows an image of ours needs no camera and no engine. All that is
made for it is removed again, Blender's own images for results included where there were none; no handler hears of it, and the render
slots keep their pictures. Only on the main thread.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from ...core.images.headers import read_header
from . import files

NAME = "Adjoint GI Denoise"
RESULTS = ("RENDER_RESULT", "COMPOSITING")  # types of Blender's own images, which a render makes where they are missing
HANDLERS = ("render_", "frame_change_", "composite_", "depsgraph_update_")

_last_slot: int | None = None  # the render slot of the last render, which Blender tells nobody


class NoDenoiser(Exception):
    """The compositor cannot be used now; its text says why."""


def denoise(image: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 `image` without noise; albedo and normal (h, w, 3) guide it and have none. Raises NoDenoiser."""
    if bpy.app.is_job_running("RENDER") or bpy.app.is_job_running("COMPOSITE"):
        raise NoDenoiser("Blender is rendering")
    height, width = image.shape[:2]
    with contextlib.ExitStack() as stack:
        try:
            folder = stack.enter_context(files.temporary_folder())
            stack.enter_context(_nothing_left())
            sources = {"Image": image, "Albedo": albedo, "Normal": normal}
            scene = _scene(width, height, {name: _image(values) for name, values in sources.items()})
            path = folder / "denoised.exr"
            scene.render.filepath = str(path)
            with _unheard(), _own_slot(), _silent():
                bpy.ops.render.render(write_still=True, scene=scene.name)
            found = _read(path, width, height)
        except (RuntimeError, OSError, AttributeError, KeyError, StopIteration) as error:
            raise NoDenoiser(" ".join(str(error).split()) or type(error).__name__) from error
    # A Blender built without Open Image Denoise, as Debian's is, hands the picture on as it is and says nothing.
    if np.ptp(image) > 0 and np.allclose(found, image, rtol=1e-5, atol=0):
        raise NoDenoiser("this Blender was built without Open Image Denoise")
    return found


def _scene(width: int, height: int, images: dict[str, bpy.types.Image]) -> bpy.types.Scene:
    """A scene whose render is what the node makes of `images`."""
    scene = bpy.data.scenes.new(NAME)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.use_compositing, render.use_sequencer, render.use_border = True, False, False
    settings = render.image_settings
    settings.file_format = "OPEN_EXR"
    settings.color_mode, settings.color_depth, settings.exr_codec = "RGB", "32", "NONE"
    tree, end = _tree(scene)
    node = tree.nodes.new("CompositorNodeDenoise")
    _choose(node)
    for name, image in images.items():
        source = tree.nodes.new("CompositorNodeImage")
        source.image = image
        tree.links.new(source.outputs[0], node.inputs[name])
    tree.links.new(node.outputs[0], end.inputs[0])
    return scene


def _tree(scene: bpy.types.Scene) -> tuple[bpy.types.NodeTree, bpy.types.Node]:
    """The scene's compositor and the node at its end: a node group from Blender 5.0 on."""
    if hasattr(scene, "compositing_node_group"):
        tree = bpy.data.node_groups.new(NAME, "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        scene.compositing_node_group = tree
        return tree, tree.nodes.new("NodeGroupOutput")
    scene.use_nodes = True
    scene.node_tree.nodes.clear()
    return scene.node_tree, scene.node_tree.nodes.new("CompositorNodeComposite")


def _choose(node: bpy.types.Node) -> None:
    """Values above 1, and guides that have no noise: properties of the node in Blender 4, inputs later."""
    if hasattr(node, "prefilter"):
        node.use_hdr, node.prefilter = True, "NONE"
    else:
        node.inputs["HDR"].default_value = True
        node.inputs["Prefilter"].default_value = "None"


def _image(values: np.ndarray) -> bpy.types.Image:
    """An image of plain numbers."""
    height, width = values.shape[:2]
    image = bpy.data.images.new(NAME, width, height, alpha=False, float_buffer=True, is_data=True)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = values
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    return image


def _read(path: Path, width: int, height: int) -> np.ndarray:
    """(height, width, 3) float32 of the file. On a full disk Blender writes a part of it, says nothing, and crashes reading that."""
    with open(path, "rb") as file:
        header = read_header(file)
    if header is None or header.danger:
        raise OSError(f"what it wrote to {path.parent.parent} is not whole: is that disk full?")
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.is_data = True
    if tuple(image.size) != (width, height):
        raise RuntimeError(f"the compositor gave {image.size[0]} x {image.size[1]} pixels")
    rgba = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(rgba)
    out = rgba.reshape(height, width, 4)[..., :3]
    if not np.isfinite(out).all():
        raise RuntimeError("the compositor gave values that are not numbers")
    return out.copy()


@contextlib.contextmanager
def _nothing_left() -> Iterator[None]:
    """Remove what is new among the datablocks that this can add."""
    kinds = (bpy.data.scenes, bpy.data.node_groups, bpy.data.images)
    before = [{item.session_uid for item in kind} for kind in kinds]
    try:
        yield
    finally:
        for kind, known in zip(kinds, before, strict=True):
            for item in [item for item in kind if item.session_uid not in known]:
                kind.remove(item)


@contextlib.contextmanager
def _unheard() -> Iterator[None]:
    """No handler of anybody's is called."""
    lists = [getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers) if name.startswith(HANDLERS)]
    before = [list(handlers) for handlers in lists]
    try:
        for handlers in lists:
            handlers.clear()
        yield
    finally:
        for handlers, own in zip(lists, before, strict=True):
            handlers[:] = own


@contextlib.contextmanager
def _own_slot() -> Iterator[None]:
    """A render into another slot than the last one frees what this slot shows, so the slot is the last one's meanwhile."""
    image = next((i for i in bpy.data.images if i.type == "RENDER_RESULT"), None)
    slots = image.render_slots if image is not None else ()
    if _last_slot is None or _last_slot >= len(slots):
        yield
        return
    before = slots.active_index
    try:
        slots.active_index = _last_slot
        yield
    finally:
        slots.active_index = before


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """What Blender prints of a render goes nowhere: it belongs to no report of ours."""
    sys.stdout.flush()
    try:
        kept = os.dup(1)
    except OSError:  # no standard output to speak of
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(nowhere)
        os.close(kept)


@bpy.app.handlers.persistent
def _note_slot(*_: object) -> None:
    """Remember the slot that the render which begins goes into."""
    global _last_slot
    image = next((i for i in bpy.data.images if i.type == "RENDER_RESULT"), None)
    _last_slot = image.render_slots.active_index if image is not None else None


@bpy.app.handlers.persistent
def _forget_slot(*_: object) -> None:
    """A file that is opened has no pictures in its slots."""
    global _last_slot
    _last_slot = None


def register() -> None:
    """Listen to renders."""
    bpy.app.handlers.render_init.append(_note_slot)
    bpy.app.handlers.load_post.append(_forget_slot)


def unregister() -> None:
    """Stop listening; doing it twice changes nothing."""
    for handlers, own in ((bpy.app.handlers.render_init, _note_slot), (bpy.app.handlers.load_post, _forget_slot)):
        if own in handlers:
            handlers.remove(own)
