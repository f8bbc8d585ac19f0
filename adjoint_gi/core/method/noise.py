"""What a result says of its own noise: how much it is, what it would take to be rid of it, and which method would do better; and that it is
not known where nothing has arrived."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import fields

import numpy as np

from ..base.errors import Notice
from ..base.settings import NO_LIMIT, Settings

TOLD = 0.15  # relative standard error of a receiver, root mean square, above which a result says so
GOOD = 0.05  # at which noise is hardly seen, and which a denoiser clears
MANY = 16  # lights; a light point finds one of them at a time


def notices(
    error: float | None, settings: Settings, label: str, measure: str, lights: int, part: str = "", lowered_by: str = ""
) -> tuple[Notice, ...]:
    """A notice where the relative standard `error` of single receivers is above what is told; none where it is not known.

    label: of the method. measure: of the solution. lights: lamps and emitting objects of the scene. part: of the light that is noisy, all
    of it by default. lowered_by: the setting that lowers it, by default the effort of the method.
    """
    if error is None or not TOLD < error < math.inf:
        return ()
    what = "pixels" if measure == "radiance" else "texels"
    noise = f"the noise of {part} at single {what}" if part else f"the noise of single {what}"
    reason = f"{noise} is about {error:.0%} of the mean light (root mean square)"
    return (Notice(label, reason, " ".join((_more(error, settings, lowered_by), _other(settings, measure, lights))).strip(), "info"),)


def darkness(light: Iterable[np.ndarray], emitted: float, settings: Settings, label: str, measure: str) -> tuple[Notice, ...]:
    """A notice where none of `light`, arrays of what has arrived at the receivers, is above 0, though `emitted` W are.

    That may be the truth or too few samples: no result can tell, so none must look as if it were sure.
    """
    light = [x for x in light if x.size]
    asked = getattr(settings, "max_length", NO_LIMIT) >= 1
    if not light or not asked or not emitted > 0 or any(x.any() for x in light):
        return ()
    what = "pixel" if measure == "radiance" else "texel"
    reason = f"no light has arrived at any {what}, of {emitted:.3g} W that are emitted: none gets there, or so little that none was found"
    effort = [f for f in fields(settings) if f.metadata["effort"]]
    more = f"raise {effort[0].metadata['label']} ({effort[0].name})" if effort else "take smaller elements"
    return (Notice(label, reason, f"See that nothing stands between the lights and what is baked; if nothing does, {more}"),)


def _more(error: float, settings: Settings, lowered_by: str) -> str:
    """How many samples it takes: the error falls with their square root."""
    for f in fields(settings):
        if f.name == lowered_by or (f.metadata["effort"] and not lowered_by):
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
