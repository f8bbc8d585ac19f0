"""Settings that several methods have: label, bounds and unit of each stand here once, and its words where they are the same.

A method's settings class lists its fields in the order in which panel, command line and manual show them, and makes each common one by
a function of this module, with the default and, where it has to say something of its own, the help text of that method.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..base.settings import NO_LIMIT, choice, setting

MOST_RAYS = 2_000_000_000  # that carry all flux, or particles

# ---- what counts, and where


def max_length(help: str) -> Any:
    """Longest path of methods that solve for all lengths at once: unbounded by default."""
    return setting(NO_LIMIT, "Max Path Length", help, min=0, max=NO_LIMIT, soft_max=64)


def distance(label: str, help: str) -> Any:
    """A length in metres; 0 lets the method choose it."""
    return setting(0.0, label, help, min=0.0, max=1e6, unit="distance")


def max_edge(help: str = "Longest edge of the elements that faces are cut into; 0 chooses it") -> Any:
    """Size of the elements."""
    return distance("Max Element Edge", help)


def direct_light(
    at_receivers: str = "At every texel, vertex or pixel, so that shadows are sharp; not part of the original method",
    on_elements: str = "On the elements, as in the paper: shadows are as sharp as the elements are small",
    label: str = "Direct Light",
    help: str = "Where light that comes straight from lamps, background and emitting faces is evaluated in the result",
) -> Any:
    """Where a method on elements evaluates direct light: "receivers" or "elements"."""
    choices = (("receivers", "At Receivers", at_receivers), ("elements", "On Elements", on_elements))
    return setting("receivers", label, help, choices=choices)


# ---- how much work: samples, rays, particles


def samples(default: int, help: str, *, label: str = "Samples", max: int = 1 << 24, soft_max: int = 4096) -> Any:
    """Random samples of each receiver, which a budget may raise."""
    return setting(default, label, help, min=1, max=max, soft_max=soft_max, effort=True)


def light_samples(default: int, help: str) -> Any:
    """Points on lights."""
    return setting(default, "Light Samples", help, min=1, max=4096, soft_max=64)


def light_points(default: int) -> Any:
    """Differential elements of lights, for methods that sum over them."""
    help = "Differential elements that stand for each lamp with a size and for all emissive surfaces"
    return setting(default, "Light Points", help, min=1, max=4096)


def element_rays(default: int, help: str) -> Any:
    """Rays that find form factors."""
    return setting(default, "Rays per Element", help, min=1, max=1 << 20, soft_max=16384)


def shooting_rays(default: int, help: str, *, effort: bool = False) -> Any:
    """Rays that carry all emitted flux; a budget may raise them where they are the `effort` of the method."""
    return setting(default, "Rays", help, min=1, max=MOST_RAYS, soft_max=100_000_000, effort=effort)


def particles(default: int, help: str) -> Any:
    """Particles from all lights, which a budget may raise."""
    return setting(default, "Particles", help, min=1, max=MOST_RAYS, soft_max=100_000_000, effort=True)


def caustic_particles(default: int) -> Any:
    """Particles of a first pass on elements."""
    help = "Particles from lamps and background for their light on elements via mirrors; 0 leaves this light out"
    return setting(default, "Caustic Particles", help, min=0, max=1_000_000_000, soft_max=10_000_000)


def mirror_depth(help: str) -> Any:
    """Mirrors in a row of a first pass on elements."""
    return setting(16, "Mirror Depth", help, min=0, max=256)


# ---- when to end


def roulette(help: str) -> Any:
    """Whether walks may end at random."""
    return setting(True, "Russian Roulette", f"End {help}; the result stays unbiased")


def tolerance(default: float, help: str) -> Any:
    """Share of what is left, at which a method ends."""
    return setting(default, "Tolerance", help, min=0.0, max=1.0)


def unshot(default: float, what: str = "the method") -> Any:
    """Tolerance of shooting."""
    return tolerance(default, f"Unshot share of the emitted flux at which {what} ends")


def max_shots(default: int, what: str = "The method") -> Any:
    """Bound of shooting."""
    return setting(default, "Max Shots", f"{what} stops with a warning after this many shots", min=1, max=MOST_RAYS)


def max_iterations(default: int, help: str, *, max: int = 100_000) -> Any:
    """Bound of relaxation."""
    return setting(default, "Max Iterations", help, min=1, max=max)


def memory_limit(help: str = "The method does not start when its matrix could need more than this") -> Any:
    """Bound of memory, MB of 2^20 bytes."""
    return setting(2048, "Memory Limit (MB)", help, min=1, max=1 << 20)


def relaxation(label: str, help: str, faster: str = "Uses new values at once") -> Any:
    """Which scheme gathers."""
    return choice("gauss_seidel", label, help, gauss_seidel=("Gauss-Seidel", faster), jacobi=("Jacobi", "Each iteration adds one bounce"))


# ---- what stands for light that is left out


def ambient_radiance(what: str) -> Any:
    """Constant radiance in the place of light that a method leaves out."""
    help = f"Uniform radiance that stands for {what} indirect light, W/m2/sr"
    return setting(0.0, "Ambient Radiance", help, min=0.0, max=1e9, soft_max=10.0)


def ambient_color() -> Any:
    """Its colour."""
    return setting((1.0, 1.0, 1.0), "Ambient Color", "Colour of the ambient radiance, which it multiplies", min=0.0, max=1.0)


def ambient_of(settings: Any) -> np.ndarray:
    """L_a of Eq. 6 to 9, (3,) float32 W m-2 sr-1."""
    return np.float32(settings.ambient) * np.array(settings.ambient_color, np.float32)
