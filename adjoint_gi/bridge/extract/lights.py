"""Lamps in radiometric units, as Cycles turns their power into light (measured: tests/blender/test_extract_lights.py).

With P = energy * 2^exposure * colour * temperature colour * strength of the Emission node, normalised (the default):
- point, spot   radiant intensity P / (4 pi), whatever the radius and the cone
- area          radiance P / (pi A), A the area after the object's scale
- sun           irradiance P on a facing surface, whatever the angle
and not normalised (Blender 4.5 and later): radiance P / pi of points, spots and areas (intensity P r^2, or P / pi without a radius),
radiance P of the sun's disk (irradiance P pi sin^2(angle / 2), or P without an angle).
"""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np

from ...core.scene.arrays import Light, Rgb
from ..host import versions
from ..host.notices import Notices
from .instances import LightInstance
from .shaders import light_emission

LARGEST_POWER = 1e15
SIZES = ("shadow_soft_size", "size", "size_y", "spread", "angle", "spot_size", "spot_blend")  # of lamps of any kind


def read_lights(instances: list[LightInstance], notices: Notices) -> tuple[Light, ...]:
    """All lamps that give light; the others are named in notices."""
    lights = (_read(item, notices) for item in instances)
    return tuple(light for light in lights if light is not None)


def _read(item: LightInstance, notices: Notices) -> Light | None:
    """One lamp, or None when it gives no light."""
    data, name = item.light, item.name
    bad = [p for p in SIZES if not np.isfinite(getattr(data, p, 0.0))]
    if bad:
        labels = ", ".join(data.bl_rna.properties[p].name for p in bad)
        notices.add(name, f"is a light with a size that is not a number ({labels}) and is left out", "Type a number")
        return None
    power = _power(data, name, notices)
    if power is None:
        return None
    lengths = np.linalg.norm(item.matrix[:3, :3], axis=0)
    if not (lengths > 0.0).all():
        notices.add(name, "is a light with a scale of zero and is left out", "Give it a scale other than zero on every axis")
        return None
    axes = item.matrix[:3, :3] / lengths
    if data.type == "SUN":
        light = _sun(data, name, power, axes)
    elif data.type == "AREA":
        light = _area(data, name, power, item.matrix, axes, lengths, notices)
    else:
        light = _point(data, name, power, item.matrix, axes, lengths)
    return light and replace(light, camera=item.camera)


def _power(data: bpy.types.Light, name: str, notices: Notices) -> np.ndarray | None:
    """(3,) float64: the power per channel in W (W m-2 for a sun), before size and angle; None when there is none to speak of."""
    emission = light_emission(data, name, notices)
    with np.errstate(over="ignore"):
        energy = float(data.energy) * np.exp2(versions.light_exposure(data))
    power = energy * np.array(data.color, np.float64) * np.array(versions.light_temperature_color(data)) * np.array(emission)
    if not np.isfinite(power).all() or np.abs(power).max() > LARGEST_POWER:
        notices.add(
            name, "is a light with a power that is not a number or too large to compute with, and is left out", "Give it a sensible power"
        )
        return None
    if (power < 0.0).any():
        notices.add(name, "is a light with negative power, which counts as 0", "Give it a positive power")
        power = np.maximum(power, 0.0)
    if not power.any():
        notices.add(name, "is a light without power", "", "info")
        return None
    return power


def _sun(data: bpy.types.SunLight, name: str, power: np.ndarray, axes: np.ndarray) -> Light:
    """A sun: its colour is the irradiance on a facing surface."""
    half = 0.5 * float(data.angle)
    if not versions.light_normalized(data) and half > 0.0:
        power = power * (np.pi * np.sin(half) ** 2)
    return Light(name, "sun", _rgb(power), **_frame(axes), angle=2.0 * half, shadow=bool(data.use_shadow))


def _point(data: bpy.types.PointLight, name: str, power: np.ndarray, matrix: np.ndarray, axes: np.ndarray, lengths: np.ndarray) -> Light:
    """A point or spot: its colour is the radiant intensity. The object's scale changes the shape of a spot's cone, not the radius."""
    radius = float(data.shadow_soft_size)
    sized = radius**2 if radius > 0.0 else 1.0 / np.pi
    intensity = power / (4.0 * np.pi) if versions.light_normalized(data) else power * sized
    cone = {}
    if data.type == "SPOT":
        cone = {
            "spot_angle": float(data.spot_size),
            "spot_blend": float(data.spot_blend),
            "spot_scale": (float(lengths[0] / lengths[2]), float(lengths[1] / lengths[2])),
        }
    return Light(
        name,
        data.type.lower(),
        _rgb(intensity),
        _rgb(matrix[:3, 3]),
        **_frame(axes),
        radius=radius,
        shadow=bool(data.use_shadow),
        soft_falloff=bool(data.use_soft_falloff) and radius > 0.0,
        **cone,
    )


def _area(
    data: bpy.types.AreaLight, name: str, power: np.ndarray, matrix: np.ndarray, axes: np.ndarray, lengths: np.ndarray, notices: Notices
) -> Light | None:
    """An area light: its colour is the radiance along its normal with full spread. Its size grows with the object's scale."""
    # Cycles is an add-on that the user may have turned off; then there are no portals.
    if getattr(getattr(data, "cycles", None), "is_portal", False):
        notices.add(name, "is a light portal, which only guides sampling, and is left out", "", "info")
        return None
    size_x = float(data.size) * float(lengths[0])
    size_y = float(data.size if data.shape in ("SQUARE", "DISK") else data.size_y) * float(lengths[1])
    round_ = data.shape in ("DISK", "ELLIPSE")
    area = size_x * size_y * (np.pi / 4.0 if round_ else 1.0)
    if not area > 1e-18:
        notices.add(name, "is an area light of size zero, which gives no light", "Give it a size")
        return None
    if abs(axes[:, 0] @ axes[:, 1]) > 1e-4:
        notices.add(name, "is a sheared area light; it is computed as a rectangle or ellipse", "Apply its parent's scale", "info")
    radiance = power / (np.pi * (area if versions.light_normalized(data) else 1.0))
    return Light(
        name,
        "area",
        _rgb(radiance),
        _rgb(matrix[:3, 3]),
        **_frame(axes),
        shape="ELLIPSE" if round_ else "RECTANGLE",
        size_x=size_x,
        size_y=size_y,
        spread=float(data.spread),
        shadow=bool(data.use_shadow),
    )


def _frame(axes: np.ndarray) -> dict[str, Rgb]:
    """An orthonormal frame near `axes` with the exact third axis, for matrices that shear."""
    z = axes[:, 2]
    x = axes[:, 0] - (axes[:, 0] @ z) * z
    x = x / np.linalg.norm(x)
    y = np.cross(z, x)
    if y @ axes[:, 1] < 0.0:
        y = -y
    return {"axis_x": _rgb(x), "axis_y": _rgb(y), "axis_z": _rgb(z)}


def _rgb(v: np.ndarray) -> Rgb:
    return (float(v[0]), float(v[1]), float(v[2]))
