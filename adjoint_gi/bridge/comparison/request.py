# SPDX-License-Identifier: GPL-3.0-or-later
"""One comparison of methods on Blender's scene: the same for the panel and the command line.

made = Compare(context, request)     # refuses, or places receivers, bakes a Cycles reference, and makes the driver
made.driver.run()                    # or start(), stop() in the background
made.pictures(made.driver.solution())
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import bpy
import numpy as np

from ...core.base.errors import Notice, SettingsError
from ...core.base.settings import Settings
from ...core.comparison import figures
from ...core.comparison.budget import Budget, Plan, Reference, constant_reference, quantity
from ...core.comparison.figures import Curve
from ...core.comparison.run import Comparison, Result
from ...core.method import registry
from ...core.method.driver import Driver
from ..baking.bake import Bake
from ..baking.watch import unchanged
from ..extract.camera import render_size
from ..host.preparation import Stages, finish_stages
from ..props.request import RECEIVERS, BakeRequest
from ..results.show import put_aside
from .cycles_reference import bake_reference

PLACES = ("texture", "camera")
LIGHT_ONLY = "light"
PICTURES = ("side by side", "differences", "error over time", "histogram")  # all but the first need a reference
FEWEST, MOST = 2, 1 << 20  # samples of a Cycles reference, which is baked in two halves
SHOWN = 220  # pixels that the longer side of one picture gets at least
LONGEST = 900  # and no more


@dataclass(frozen=True)
class ReferenceChoice:
    """kind "method", "cycles", "constant" or "none"; seconds 0 means four times the budget's."""

    kind: str = "method"
    method: str = "path_tracing"
    seconds: float = 0.0
    samples: int = 512
    value: tuple[float, ...] = (1.0,)

    @classmethod
    def parse(cls, text: str) -> ReferenceChoice:
        """From "METHOD[:seconds]", "cycles[:samples]", "constant=V" or "constant=R,G,B", "none"; raises SettingsError."""
        head, _, rest = text.partition(":")
        try:
            if text == "none":
                return cls("none")
            if head == "cycles":
                samples = int(rest) if rest else cls.samples
                if not FEWEST <= samples <= MOST:
                    raise SettingsError("--reference", f"{samples} samples are not possible", f"Give Cycles {FEWEST} to {MOST:,} samples")
                return cls("cycles", samples=samples)
            if text.startswith("constant="):
                value = tuple(float(v) for v in text.partition("=")[2].split(","))
                if len(value) in (1, 3) and all(math.isfinite(v) for v in value):
                    return cls("constant", value=value)
            else:
                registry.method(head)
                seconds = float(rest) if rest else cls.seconds
                if rest and not (math.isfinite(seconds) and seconds > 0):
                    raise SettingsError("--reference", f"{rest} seconds are not possible", "Give a number above 0, or none for the default")
                return cls("method", head, seconds)
        except ValueError:
            pass
        remedy = "Write METHOD, METHOD:SECONDS, cycles, cycles:SAMPLES, constant=VALUE, constant=R,G,B or none"
        raise SettingsError("--reference", f"cannot read {text!r}", remedy)


@dataclass(frozen=True)
class CompareRequest:
    """What is compared, where and how. methods empty means all that fit; `resolution` is texels a side, or pixels along the picture's
    longer side. `output` is the folder for a page, JSON and PNG files; empty means none."""

    methods: tuple[str, ...] = ()
    budget: Budget = Budget()
    reference: ReferenceChoice = ReferenceChoice()
    receivers: str = "texture"
    objects: tuple[str, ...] = ()
    resolution: int = 32
    settings: Mapping[str, Settings] = field(default_factory=dict)
    repeats: int = 4
    seed: int = 0
    output: str = ""

    def plan(self) -> Plan:
        """For the core; raises SettingsError."""
        named = self.methods or tuple(m.spec.id for m in registry.methods())
        for name in named:
            registry.method(name)
        r = self.reference
        if self.budget.kind == "error" and r.kind == "none":
            raise SettingsError("budget", "an error needs a reference, and none is chosen", "Choose a reference, or another budget")
        seconds = r.seconds or 4 * self.budget.seconds
        return Plan(named, self.budget, r.method if r.kind == "method" else "", seconds, self.settings, self.repeats, self.seed)


class Compare:
    """See the head of this file. `notices` were found before the run."""

    def __init__(self, context: bpy.types.Context, request: CompareRequest, now: bool = True) -> None:
        """Raises `AdjointError` when it is refused. May make lightmap UV layers and objects for curves, as a bake does.

        Without `now` only what can be seen at once is looked at, and the caller has to run `preparing` before anything else.
        """
        self.request, self.plan = request, request.plan()
        if request.receivers not in PLACES:
            raise SettingsError("receivers", f"{request.receivers!r} is not possible", "Choose one of: " + ", ".join(PLACES))
        self.camera = request.receivers == "camera"
        if self.camera and request.reference.kind == "cycles":
            raise SettingsError("reference", "Cycles bakes texels, not a camera's picture", "Compare on textures, or choose a method")
        self.scene_name = context.scene.name
        self.bake = Bake(context, _placing(context, request), now=False)
        if now:
            finish_stages(self.preparing())

    def preparing(self) -> Stages[None]:
        """Place the receivers, bake a reference and make the driver. Raises as the class does; then what was made is taken back."""
        # Step 1: receivers, checked and placed as for a bake of a method that takes the scene as it is.
        yield from self.bake.preparing()
        try:
            self.notices: list[Notice] = [n for n in self.bake.notices if n.severity == "warning"]
            self.sheets = [] if self.camera else self.bake.writer.sheets

            # Step 2: a reference that no method makes.
            reference = yield from self._reference()
        except BaseException:
            self.bake.take_back()
            raise
        self.bake.keep()
        world, receivers = self.bake.driver.world, self.bake.driver.receivers
        self.driver = Driver(Comparison(reference), world, receivers, self.plan)

    def _reference(self) -> Stages[Reference | None]:
        """The constant, or what Cycles bakes now, in one call that Blender waits for; None where a method makes it."""
        choice, world, count = self.request.reference, self.bake.driver.world, self.bake.driver.receivers.count
        if choice.kind == "constant":
            return constant_reference(choice.value, count)
        if choice.kind != "cycles":
            return None
        same = unchanged()
        yield "Baking a reference by Cycles"
        same()
        context = bpy.context
        longest = max((s.max_length for s in self.plan.settings.values()), default=Settings().max_length)
        with put_aside(context.scene, context.view_layer):
            reference = bake_reference(context, world, self.sheets, count, choice.samples, longest)
        self.notices += reference.notices
        return reference

    # ---- pictures

    def picture(self, values: np.ndarray) -> np.ndarray:
        """(h, w, c) float32 of one value for each receiver (n, c): the camera's picture, or all lightmaps side by side."""
        values = np.asarray(values, np.float32).reshape(len(values), -1)
        if self.request.receivers == "camera":
            r = self.driver.receivers
            return _enlarged(values.reshape(r.height, r.width, -1))
        tiles = [s.lightmap.image(values[s.part]) for s in self.sheets]
        columns = max(1, math.ceil(math.sqrt(len(tiles))))
        h, w, c = tiles[0].shape
        rows = -(-len(tiles) // columns)
        gap = 1 if len(tiles) > 1 else 0
        out = np.zeros((rows * (h + gap) - gap, columns * (w + gap) - gap, c), np.float32)
        for i, tile in enumerate(tiles):
            # From the upper left, in reading order.
            y, x = (rows - 1 - i // columns) * (h + gap), (i % columns) * (w + gap)
            out[y : y + h, x : x + w] = tile
        return _enlarged(out)

    def pictures(self, result: Result) -> dict[str, np.ndarray]:
        """All figures by name, (h, w, 3) float32 sRGB-encoded 0..1, row 0 at the bottom; empty without a result."""
        entries = [e for e in result.entries if (e.solution.weight > 0).any()]
        if not entries:
            return {}
        reference = result.reference
        labels = [e.label for e in entries]
        images = [self.picture(quantity(e.solution)) for e in entries]
        shown, captions = list(images), list(labels)
        if reference is not None:
            target = self.picture(np.where(reference.valid[:, None], reference.values, 0))
            shown, captions = [target, *images], ["Reference", *labels]
        exposure = figures.exposure_for(shown[0] if reference is not None else images[0])
        anything = np.any([e.solution.weight > 0 for e in entries], axis=0).astype(np.float32)
        side, differences, curve, histogram = PICTURES
        out = {side: figures.side_by_side(shown, captions, exposure, self.picture(anything)[..., 0] > 0)}
        if reference is None:
            return out
        valid = self.picture(reference.valid.astype(np.float32))[..., 0] > 0
        mean = max(reference.mean, 1e-30)
        errors = [_relative(e.solution, reference, mean) for e in entries]
        limit = figures.round_limit(float(np.median([np.percentile(np.abs(x), 95) if len(x) else 0.0 for x in errors])))
        out[differences] = figures.differences(images, target, valid, labels, limit * mean, mean)
        curves = [
            Curve(e.label, np.array([(p.seconds, 100 * p.error) for p in e.curve if p.error is not None], float).reshape(-1, 2))
            for e in entries
        ]
        floor = 100 * reference.noise if reference.noise else None
        out[curve] = figures.plot(curves, "seconds", "relative RMSE, %", floor=floor)
        out[histogram] = figures.histogram(errors, labels, 2 * limit)
        return out


def _relative(solution: object, reference: Reference, mean: float) -> np.ndarray:
    """(m,) differences of all known receivers and colours as shares of the reference's mean."""
    return ((quantity(solution) - reference.values)[reference.valid] / mean).ravel()


def _enlarged(image: np.ndarray) -> np.ndarray:
    """Small pictures get whole multiples of their pixels, large ones lose some."""
    longest = max(image.shape[:2])
    if longest < SHOWN:
        k = -(-SHOWN // longest)
        return np.repeat(np.repeat(image, k, axis=0), k, axis=1)
    step = -(-longest // LONGEST)
    return image[::step, ::step]


def _placing(context: bpy.types.Context, request: CompareRequest) -> BakeRequest:
    """The bake whose receivers are compared; its method is only the one that the scene is checked for."""
    target = "render" if request.receivers == "camera" else "texture"
    fitting = [m for m in registry.methods() if m.spec.answers == LIGHT_ONLY and RECEIVERS[target] in m.spec.receivers]
    if not fitting:
        raise SettingsError("receivers", f"no method answers {request.receivers}", "Choose other receivers")
    solver = max(fitting, key=lambda m: (len(m.spec.lobes), not m.spec.uses_elements))
    settings = dataclasses.replace(solver.Settings(), seed=request.seed)
    if target == "texture":
        return BakeRequest(solver.spec.id, settings, target, request.objects, resolution=request.resolution)
    width, height = render_size(context.scene)
    scale = request.resolution / max(width, height)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return BakeRequest(solver.spec.id, settings, target, output=bpy.app.tempdir, width=size[0], height=size[1])
