# SPDX-License-Identifier: GPL-3.0-or-later
"""What one bake is asked to do, the same from the panel, the command line and a script."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from ...core.base.errors import Notice, SettingsError, raise_all
from ...core.base.settings import Settings
from ...core.method import registry
from ...core.method.registry import Solver
from ...core.method.solution import QUANTITIES
from ...core.receivers.texels import MAX_RESOLUTION

LIGHT = ("irradiance", "radiosity")  # quantities that only methods have which answer light

# What a target needs a method to answer.
RECEIVERS = {"texture": "texels", "attribute": "vertices", "render": "camera"}
DOMAINS = ("POINT", "CORNER")
MAX_DENSITY = 1e6  # texels a metre
DEFAULT_METHOD = "path_tracing"


@dataclass(frozen=True)
class BakeRequest:
    """One bake.

    objects      names of mesh objects; empty means all that are rendered
    quantity     one of `core.solution.QUANTITIES`; a camera picture always holds radiance and all its parts
    resolution   texels a side of each lightmap
    atlas        one lightmap for all objects instead of one each
    uv_layer     UV layer to bake into; empty means ours, made where it is missing
    texels_per_metre   density of lightmaps, up to what `resolution` has room for; 0 fills the image
    renew_uvs    make our UV layers anew even where they fit
    margin       texels by which charts are extended
    subsamples   points in each texel
    attribute    name of the colour attribute
    new_object   write the attribute to an object made of the elements, or by other methods to a copy that carries the evaluated mesh
    instances    bake instances too, each as an object of ours; objects named then mean what they make as well
    output       folder for files; empty means none
    width, height   of the camera picture; 0 means those of the render settings
    denoise      take noise out before writing, of methods that have any; the panel and the command line have a default of their own,
                 `denoises_by_default`
    left_out     names of objects that are not baked although none are named: they cannot receive (filled in by pre-flight)
    separate     names of objects whose attribute goes to an object of its own, because their mesh cannot hold it (the same)
    """

    method: str
    settings: Settings
    target: str = "texture"
    objects: tuple[str, ...] = ()
    quantity: str = "irradiance"
    resolution: int = 512
    atlas: bool = False
    uv_layer: str = ""
    texels_per_metre: float = 0.0
    renew_uvs: bool = False
    margin: int = 8
    subsamples: int = 4
    attribute: str = "AdjointGI"
    domain: str = "CORNER"
    new_object: bool = False
    instances: bool = False
    output: str = ""
    width: int = 0
    height: int = 0
    denoise: bool = False
    left_out: tuple[str, ...] = ()
    separate: tuple[str, ...] = ()

    @property
    def solver(self) -> Solver:
        """The method; raises `SettingsError` when there is none of this name."""
        return registry.method(self.method)

    def as_dict(self) -> dict[str, Any]:
        """All fields, ready for JSON."""
        return asdict(self)

    def problems(self) -> list[Notice]:
        """Fields that contradict the method or their bounds."""
        out: list[Notice] = []
        try:
            solver = self.solver
            if not isinstance(self.settings, solver.Settings):
                out.append(_error("settings", f"are not those of {solver.spec.label}", f"Give {solver.Settings.__name__} of that method"))
            needed = RECEIVERS.get(self.target)
            if needed and needed not in solver.spec.receivers:
                out.append(_error(solver.spec.label, f"cannot be baked to {self.target}", "Choose another method or target"))
            potential = solver.spec.answers == "potential"
            if self.target != "render" and self.quantity in (LIGHT if potential else ("potential",)):
                remedy = f"Choose {'potential' if potential else 'irradiance'} or another quantity of the method"
                out.append(_error(solver.spec.label, f"does not answer {self.quantity}", remedy))
        except SettingsError as error:
            out.append(error.notice)
        choices = {"target": tuple(RECEIVERS), "quantity": QUANTITIES, "domain": DOMAINS}
        for name, known in choices.items():
            if getattr(self, name) not in known:
                out.append(_error(name, f"{getattr(self, name)!r} is not possible", "Choose one of: " + ", ".join(known)))
        if self.target == "texture":
            out += _bounds("resolution", self.resolution, 1, MAX_RESOLUTION)
            if not 0.0 <= self.texels_per_metre <= MAX_DENSITY:
                out.append(_error("texels_per_metre", f"{self.texels_per_metre:g} is not possible", f"Choose 0 to {MAX_DENSITY:g}"))
            out += _bounds("margin", self.margin, 0, MAX_RESOLUTION)
            out += _bounds("subsamples", self.subsamples, 1, 256)
        if self.target == "render":
            # 0 stands for the size of the render settings, which nobody types.
            sizes = (("width", self.width), ("height", self.height))
            out += [notice for name, value in sizes if value for notice in _bounds(name, value, 1, 65536)]
        if self.target == "attribute" and not self.attribute.strip():
            out.append(_error("attribute", "has no name", "Give a name, such as AdjointGI"))
        return out


def denoises_by_default(method: str, target: str) -> bool:
    """Whether a bake is denoised where nothing is said of it: lightmaps and attributes by the default method, which are there to please;
    what is chosen to be compared, and pictures, are as they were computed."""
    return method == DEFAULT_METHOD and target != "render"


def fitting_quantity(solver: Solver, quantity: str) -> str:
    """`quantity`, or potential where a method that answers only that is asked for light."""
    return "potential" if solver.spec.answers == "potential" and quantity in LIGHT else quantity


def raise_first(notices: list[Notice]) -> None:
    """Raise `AdjointError` for the first notice that is an error; it carries the other errors as `others`."""
    raise_all([n for n in notices if n.severity == "error"])


def _bounds(name: str, value: int, low: int, high: int) -> list[Notice]:
    return [] if low <= value <= high else [_error(name, f"{value} is not possible", f"Choose {low} to {high}")]


def _error(object: str, reason: str, remedy: str) -> Notice:
    return Notice(object, reason, remedy, "error")
