"""The camera: position, axes and window, as Blender's own viewplane has it."""

from __future__ import annotations

import bpy
import numpy as np

from ...core.scene.arrays import Camera, Rgb
from ..host.notices import Notices

NO_PICTURE = "so there is no picture through it"  # words of notices that refuse a picture, and nothing else


def read_camera(
    scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, resolution: tuple[int, int] | None, notices: Notices
) -> Camera | None:
    """The scene's active camera, or None with a notice when there is none or it cannot be used.

    `resolution` replaces the size of the render settings; it is then taken as square pixels unless the scene says otherwise.
    """
    if scene.camera is None:
        notices.add("Camera", "the scene has no active camera", "Add one to render a picture; baking does not need it", "info")
        return None
    obj = scene.camera.evaluated_get(depsgraph)
    data = obj.data
    if obj.type != "CAMERA":
        notices.add(obj.name, f"is the active camera but not a camera, {NO_PICTURE}", "Choose a camera object", "info")
        return None
    if data.type not in ("PERSP", "ORTHO"):
        notices.add(obj.name, f"is a {data.type.lower()} camera, {NO_PICTURE}", "Make it perspective or orthographic", "info")
        return None
    matrix = np.array(obj.matrix_world, np.float64)
    axes = matrix[:3, :3] / np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-300)
    if not np.isfinite(matrix).all() or abs(np.linalg.det(axes)) < 1e-6:
        notices.add(obj.name, f"has a scale of zero or a matrix that is not a number, {NO_PICTURE}", "Clear its scale", "info")
        return None
    width, height = resolution or render_size(scene)
    frame = _frame(data, scene.render, width, height)
    if not (np.isfinite((*frame, data.clip_start, data.clip_end)).all() and frame[0] < frame[1] and frame[2] < frame[3]):
        notices.add(obj.name, f"has a lens, sensor or clipping that is not a number, {NO_PICTURE}", "Type sensible numbers", "info")
        return None
    radius, focus = _lens(obj, depsgraph, notices)
    return Camera(
        kind="perspective" if data.type == "PERSP" else "orthographic",
        position=_rgb(matrix[:3, 3]),
        right=_rgb(axes[:, 0]),
        up=_rgb(axes[:, 1]),
        forward=_rgb(-axes[:, 2]),
        frame=frame,
        width=width,
        height=height,
        clip_start=float(data.clip_start),
        clip_end=float(data.clip_end),
        aperture_radius=radius,
        focus_distance=focus,
    )


def render_size(scene: bpy.types.Scene) -> tuple[int, int]:
    """Width and height in pixels of a render with the scene's percentage."""
    r = scene.render
    return max(1, int(r.resolution_x * r.resolution_percentage / 100)), max(1, int(r.resolution_y * r.resolution_percentage / 100))


def _frame(data: bpy.types.Camera, render: bpy.types.RenderSettings, width: int, height: int) -> tuple[float, float, float, float]:
    """(left, right, bottom, top) at distance 1, or in metres when orthographic; lens shift and pixel aspect included.

    The sensor's size spans the larger side of the picture (AUTO), its width or its height; the other side follows.
    """
    aspect_x, aspect_y = float(render.pixel_aspect_x), float(render.pixel_aspect_y)
    fit = data.sensor_fit
    if fit == "AUTO":
        fit = "HORIZONTAL" if aspect_x * width >= aspect_y * height else "VERTICAL"
        sensor = data.sensor_width
    else:
        sensor = data.sensor_height if fit == "VERTICAL" else data.sensor_width
    # Step 1: the extent of the fitted side, in pixels of width `aspect_x`.
    tall = height * aspect_y / aspect_x
    fitted = float(width) if fit == "HORIZONTAL" else tall
    # Step 2: the size of such a pixel at distance 1 (perspective) or in metres (orthographic).
    pixel = (data.ortho_scale if data.type == "ORTHO" else sensor / data.lens) / fitted
    # Step 3: the shifted window.
    dx, dy = data.shift_x * fitted, data.shift_y * fitted
    return (pixel * (dx - 0.5 * width), pixel * (dx + 0.5 * width), pixel * (dy - 0.5 * tall), pixel * (dy + 0.5 * tall))


def _lens(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, notices: Notices) -> tuple[float, float]:
    """Aperture radius and distance of focus in metres as Cycles takes them; radius 0 without depth of field."""
    data, dof = obj.data, obj.data.dof
    if not dof.use_dof:
        return 0.0, float(dof.focus_distance)
    # Step 1: the radius is half the focal length (mm) over the f-stop; orthographic cameras count as 1 m long.
    length = 1.0 if data.type == "ORTHO" else 1e-3 * data.lens
    radius = length / (2 * max(float(dof.aperture_fstop), 1e-5))
    # Step 2: an object in focus sets the distance along the view.
    focus = float(dof.focus_distance)
    if dof.focus_object is not None:
        target = dof.focus_object.evaluated_get(depsgraph)
        matrix = target.matrix_world
        if target.pose is not None and dof.focus_subtarget in target.pose.bones:
            matrix = matrix @ target.pose.bones[dof.focus_subtarget].matrix
        view = np.array(obj.matrix_world.col[2][:3])
        away = np.array(obj.matrix_world.translation) - np.array(matrix.translation)
        focus = abs(float(away @ view)) / max(float(np.linalg.norm(view)), 1e-300)
    if not (np.isfinite(radius) and np.isfinite(focus) and focus > 0):
        notices.add(obj.name, "has a focus that lies in the camera or is not a number; everything is sharp", "Move what it focuses on")
        return 0.0, 10.0
    if dof.aperture_blades >= 3 or dof.aperture_ratio != 1.0:
        notices.add(obj.name, "has an aperture with blades or a ratio, which is taken as round", "", "info")
    notices.add(obj.name, "has depth of field, which only distribution ray tracing computes", "Other methods draw everything sharp", "info")
    return radius, focus


def _rgb(v: np.ndarray) -> Rgb:
    return (float(v[0]), float(v[1]), float(v[2]))
