"""The arithmetic of Blender's colour and converter nodes, as Cycles computes it."""

from __future__ import annotations

import math
from collections.abc import Callable

import bpy
import numpy as np

from ...core.base.color import luminance
from ...core.scene.arrays import Color
from .nodes import Place

Mapping = Callable[[np.ndarray], np.ndarray]


def blend(kind: str, factor: Color, a: Color, b: Color) -> Color | None:
    """A Mix node as a polynomial; other blend types only for constants, None where that is not possible."""
    rest = factor.complement()
    if kind == "MIX":
        return a * rest + b * factor
    if kind == "ADD":
        return a + b * factor
    if kind == "MULTIPLY":
        return a * (rest + b * factor)
    if kind == "SUBTRACT":
        return a + b * factor * -1.0
    if kind == "SCREEN":
        return ((rest + b.complement() * factor) * a.complement()).complement()
    if not (factor.is_constant and a.is_constant and b.is_constant):
        return None
    f, x, y = np.array(factor.constant), np.array(a.constant), np.array(b.constant)
    with np.errstate(divide="ignore", invalid="ignore"):
        mixed = {
            "DARKEN": np.minimum(x, y),
            "LIGHTEN": np.maximum(x, y),
            "DIFFERENCE": np.abs(x - y),
            "EXCLUSION": np.maximum(x + y - 2.0 * x * y, 0.0),
            "DIVIDE": np.where(y != 0.0, x / y, x),
            "OVERLAY": np.where(x < 0.5, 2.0 * x * y, 1.0 - 2.0 * (1.0 - x) * (1.0 - y)),
        }.get(kind)
    return None if mixed is None else Color.of(*(x * (1.0 - f) + mixed * f).tolist())


def math_polynomial(operation: str, v: list[Color]) -> Color | None:
    """A Math node of images or attributes, where it is a sum or product."""
    if operation == "ADD":
        return v[0] + v[1]
    if operation == "SUBTRACT":
        return v[0] + v[1] * -1.0
    if operation == "MULTIPLY":
        return v[0] * v[1]
    if operation == "MULTIPLY_ADD":
        return v[0] * v[1] + v[2]
    if operation == "DIVIDE" and v[1].is_constant and v[1].constant[0] != 0.0:
        return v[0] * (1.0 / v[1].constant[0])
    return None


def math_constant(operation: str, v: list[float]) -> float | None:
    """A Math node of constants; None when the operation is not known."""
    a, b, c = (*v, 0.0, 0.0, 0.0)[:3]
    operations: dict[str, Callable[[], float]] = {
        "ADD": lambda: a + b,
        "SUBTRACT": lambda: a - b,
        "MULTIPLY": lambda: a * b,
        "DIVIDE": lambda: a / b if b else 0.0,
        "MULTIPLY_ADD": lambda: a * b + c,
        "POWER": lambda: a**b if a >= 0.0 or b == int(b) else 0.0,
        "LOGARITHM": lambda: math.log(a, b) if a > 0.0 and b > 0.0 else 0.0,
        "SQRT": lambda: math.sqrt(max(a, 0.0)),
        "INVERSE_SQRT": lambda: 1.0 / math.sqrt(a) if a > 0.0 else 0.0,
        "ABSOLUTE": lambda: abs(a),
        "EXPONENT": lambda: math.exp(a),
        "MINIMUM": lambda: min(a, b),
        "MAXIMUM": lambda: max(a, b),
        "LESS_THAN": lambda: float(a < b),
        "GREATER_THAN": lambda: float(a > b),
        "SIGN": lambda: float((a > 0.0) - (a < 0.0)),
        "COMPARE": lambda: float(abs(a - b) <= max(c, 1e-5)),
        "ROUND": lambda: float(math.floor(a + 0.5)),
        "FLOOR": lambda: float(math.floor(a)),
        "CEIL": lambda: float(math.ceil(a)),
        "TRUNC": lambda: float(math.trunc(a)),
        "FRACT": lambda: a - math.floor(a),
        "MODULO": lambda: math.fmod(a, b) if b else 0.0,
        "SINE": lambda: math.sin(a),
        "COSINE": lambda: math.cos(a),
        "TANGENT": lambda: math.tan(a),
        "RADIANS": lambda: math.radians(a),
        "DEGREES": lambda: math.degrees(a),
    }
    if operation not in operations:
        return None
    try:
        return operations[operation]()
    except (OverflowError, ZeroDivisionError, ValueError):
        return 0.0


def main_input(sockets: dict[str, Place]) -> str:
    """Name of the input that a function node maps: its colour, else its value or factor."""
    for name in ("Color", "Value"):
        if name in sockets:
            return name
    return next(iter(sockets))


def _invert(node: bpy.types.Node, n: dict[str, float]) -> Mapping:
    factor = n.get("Fac", n.get("Factor", 1.0))
    return lambda c: c * (1.0 - factor) + (1.0 - c) * factor


def _gamma(node: bpy.types.Node, n: dict[str, float]) -> Mapping:
    return lambda c: np.where(c > 0.0, np.maximum(c, 0.0) ** n["Gamma"], c)


def _bright(node: bpy.types.Node, n: dict[str, float]) -> Mapping:
    contrast = n["Contrast"]
    return lambda c: np.maximum(c * (1.0 + contrast) + (n.get("Bright", n.get("Brightness", 0.0)) - 0.5 * contrast), 0.0)


def _hsv(node: bpy.types.Node, n: dict[str, float]) -> Mapping:
    factor = n.get("Fac", n.get("Factor", 1.0))

    def change(c: np.ndarray) -> np.ndarray:
        h, s, v = _rgb_to_hsv(c)
        h = np.mod(h + n["Hue"] + 0.5, 1.0)
        s = np.clip(s * n["Saturation"], 0.0, 1.0)
        return np.maximum(_hsv_to_rgb(h, s, v * n["Value"]) * factor + c * (1.0 - factor), 0.0)

    return change


def _grey(node: bpy.types.Node, n: dict[str, float]) -> Mapping:
    return lambda c: np.repeat(luminance(c)[:, None], 3, axis=1)


def _ramp(node: bpy.types.Node, n: dict[str, float]) -> Mapping:
    # Cycles' table: 256 intervals with linear interpolation; of constant steps, each interval has the colour of its beginning.
    table = np.array([node.color_ramp.evaluate(i / 256.0)[:3] for i in range(257)], np.float32)
    step = node.color_ramp.interpolation == "CONSTANT"

    def look_up(c: np.ndarray) -> np.ndarray:
        x = np.clip(c[:, 0], 0.0, 1.0) * 256.0
        low = np.minimum(x.astype(np.int64), 256)
        if step:
            return table[low]
        high = np.minimum(low + 1, 256)
        f = (x - low)[:, None]
        return (table[low] * (1.0 - f) + table[high] * f).astype(np.float32)

    return look_up


def _curve(node: bpy.types.Node, n: dict[str, float]) -> Mapping:
    factor = n.get("Fac", n.get("Factor", 1.0))
    mapping = node.mapping
    mapping.initialize()
    # Cycles' table: 256 intervals between the outermost points of all curves, and beyond them the line through the last two entries.
    points = [p.location[0] for curve in mapping.curves for p in curve.points]
    x = np.linspace(min(points), max(points), 257)
    combined = np.array([mapping.evaluate(mapping.curves[3], float(t)) for t in x])
    tables = [np.array([mapping.evaluate(mapping.curves[i], float(t)) for t in combined]) for i in range(3)]
    extend = mapping.extend == "EXTRAPOLATED"

    def look_up(c: np.ndarray) -> np.ndarray:
        out = np.stack([_interpolated(c[:, i], x, tables[i], extend) for i in range(3)], axis=1)
        return (c * (1.0 - factor) + out * factor).astype(np.float32)

    return look_up


def _interpolated(at: np.ndarray, x: np.ndarray, table: np.ndarray, extend: bool) -> np.ndarray:
    """A table over even places x, between them linear; beyond its ends the end's value, or its slope goes on."""
    inside = np.interp(at, x, table)
    step = x[1] - x[0]
    if not extend or step == 0:
        return inside
    return inside + np.minimum(at - x[0], 0) / step * (table[1] - table[0]) + np.maximum(at - x[-1], 0) / step * (table[-1] - table[-2])


def _clamp(node: bpy.types.Node, n: dict[str, float]) -> Mapping:
    low, high = n["Min"], n["Max"]
    if node.clamp_type == "RANGE" and low > high:
        low, high = high, low
    return lambda c: np.minimum(np.maximum(c, low), high)


def _blackbody(node: bpy.types.Node, n: dict[str, float]) -> Mapping:
    table = np.array(BLACKBODY)
    inverse = 1.0 / table[::-1, 0]

    def look_up(c: np.ndarray) -> np.ndarray:
        x = 1.0 / np.clip(c[:, 0].astype(np.float64), table[0, 0], table[-1, 0])
        return np.stack([np.interp(x, inverse, table[::-1, 1 + i]) for i in range(3)], axis=1).astype(np.float32)

    return look_up


def _rgb_to_hsv(c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    v, low = c.max(axis=1), c.min(axis=1)
    delta = v - low
    safe = np.where(delta > 0.0, delta, 1.0)
    r, g, b = c[:, 0], c[:, 1], c[:, 2]
    h = np.where(v == r, (g - b) / safe, np.where(v == g, 2.0 + (b - r) / safe, 4.0 + (r - g) / safe)) / 6.0
    return np.where(delta > 0.0, np.mod(h, 1.0), 0.0), np.where(v > 0.0, delta / np.where(v > 0.0, v, 1.0), 0.0), v


def _hsv_to_rgb(h: np.ndarray, s: np.ndarray, v: np.ndarray) -> np.ndarray:
    k = np.stack([np.abs(h * 6.0 - 3.0) - 1.0, 2.0 - np.abs(h * 6.0 - 2.0), 2.0 - np.abs(h * 6.0 - 4.0)], axis=1)
    return ((np.clip(k, 0.0, 1.0) - 1.0) * s[:, None] + 1.0) * v[:, None]


# Kelvin and Rec.709 red, green, blue of luminance 1, as Cycles 4.2, 5.0 and 5.2 emit it (measured). Between them the colour is nearly
# linear in 1 / kelvin: within 1 % and 0.002. Below 800 and above 12,000 K Cycles keeps the last colour too.
BLACKBODY = (
    (800, 5.414, 0, 0),
    (965, 4.731, 0.0005, 0),
    (1060, 4.394, 0.1008, 0),
    (1167, 4.06, 0.1998, 0),
    (1370, 3.537, 0.3542, 0),
    (1902, 2.638, 0.6141, 0),
    (2000, 2.52, 0.6469, 0.0204),
    (2200, 2.314, 0.7036, 0.0654),
    (2350, 2.183, 0.7389, 0.1016),
    (2500, 2.068, 0.7693, 0.1394),
    (2650, 1.966, 0.7956, 0.1785),
    (2800, 1.876, 0.8184, 0.2184),
    (3000, 1.771, 0.8443, 0.2722),
    (3315, 1.632, 0.8777, 0.3559),
    (3700, 1.499, 0.9063, 0.4579),
    (4300, 1.343, 0.9377, 0.6061),
    (5000, 1.213, 0.9608, 0.7622),
    (6500, 1.043, 0.9841, 1.035),
    (8000, 0.9473, 0.9916, 1.237),
    (12000, 0.8263, 0.9945, 1.566),
)

FUNCTIONS: dict[str, Callable[[bpy.types.Node, dict[str, float]], Mapping]] = {
    "ShaderNodeInvert": _invert,
    "ShaderNodeGamma": _gamma,
    "ShaderNodeBrightContrast": _bright,
    "ShaderNodeHueSaturation": _hsv,
    "ShaderNodeRGBToBW": _grey,
    "ShaderNodeValToRGB": _ramp,
    "ShaderNodeRGBCurve": _curve,
    "ShaderNodeClamp": _clamp,
    "ShaderNodeBlackbody": _blackbody,
}
