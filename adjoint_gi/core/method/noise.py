"""What a result says of its own noise: how much it is, what it would take to be rid of it, and which method would do better."""

from __future__ import annotations

import math
from dataclasses import fields

from ..base.errors import Notice
from ..base.settings import Settings

TOLD = 0.15  # relative standard error of a receiver, root mean square, above which a result says so
GOOD = 0.05  # at which noise is hardly seen, and which a denoiser clears
MANY = 16  # lights; a light point finds one of them at a time


def notices(error: float | None, settings: Settings, label: str, measure: str, lights: int) -> tuple[Notice, ...]:
    """A notice where the relative standard `error` of single receivers is above what is told; none where it is not known.

    label: of the method. measure: of the solution. lights: lamps and emitting objects of the scene.
    """
    if error is None or not TOLD < error < math.inf:
        return ()
    what = "pixels" if measure == "radiance" else "texels"
    reason = f"the noise of single {what} is about {error:.0%} of the mean light (root mean square)"
    return (Notice(label, reason, " ".join((_more(error, settings), _other(settings, measure, lights))).strip(), "info"),)


def _more(error: float, settings: Settings) -> str:
    """How many samples it takes: the error falls with their square root."""
    for f in fields(settings):
        if f.metadata["effort"]:
            wanted = 2 ** math.ceil(math.log2(getattr(settings, f.name) * (error / GOOD) ** 2))
            return f"About {wanted:,} {f.metadata['label']} ({f.name}) bring it to {GOOD:.0%}."
    return "More rays and light samples lower it."


def _other(settings: Settings, measure: str, lights: int) -> str:
    """A method that does better, where one is likely to."""
    if any(f.name == "particles" and f.metadata["effort"] for f in fields(settings)):
        return "Path Tracing does better where few particles arrive"
    if measure == "radiance":
        return "Where light comes through mirrors or small openings Progressive Multi-Pass does better"
    if lights >= MANY:
        return f"With {lights} lights Particle Tracing does better: particles start from all of them"
    return "With small or many lights, or light through small openings, Particle Tracing does better"
