# SPDX-License-Identifier: GPL-3.0-or-later
"""What a scene remembers: the choice of method, the settings of every method, the output, and the numbers of the last bake.

`Scene.adjoint_gi` holds everything. Menus, settings and their defaults are generated from the registry of methods.
"""

from __future__ import annotations

import dataclasses

import bpy

from .... import solvers
from ...core.base.errors import SettingsError
from ...core.base.settings import Settings
from ...core.method import registry
from ...core.method.registry import MethodSpec, Nature, Solver, Strategy
from ..host.versions import FOLDER
from ..results import show as results
from . import fields
from .records import ADJOINTGI_PG_notice, ADJOINTGI_PG_result
from .request import MAX_DENSITY, BakeRequest, denoises_by_default, fitting_quantity

__all__ = ["MethodSpec", "chosen", "folder_of", "group_name", "method_label", "own_and_common", "quadrant", "request_of", "settings_of"]

STRATEGIES = (
    (Strategy.GATHERING.value, "Gathering", "Solve the radiance equation: light is collected backwards from where it is wanted", 0),
    (Strategy.SHOOTING.value, "Shooting", "Solve the potential equation: light is followed forwards from where it is emitted", 1),
)
NATURES = (
    (Nature.DETERMINISTIC.value, "Deterministic", "Solve a system of equations: no noise, an error that depends on the mesh", 0),
    (Nature.NONDETERMINISTIC.value, "Nondeterministic", "Estimate by random samples: noise that falls with their number, no mesh", 1),
)
TARGETS = (
    ("texture", "Image Texture", "A lightmap: one texture for each object, or one for all of them", 0),
    ("attribute", "Color Attribute", "A float color attribute on the points or corners of each mesh", 1),
    ("render", "Camera Picture", "A picture through the scene's camera", 2),
)
QUANTITIES = (
    ("irradiance", "Irradiance", "Light that arrives, direct and indirect; multiply by the albedo to shade", 0),
    ("radiosity", "Radiosity", "Light that leaves: emitted and diffusely reflected", 1),
    ("direct", "Direct", "Irradiance that comes straight from lights and emitting surfaces", 2),
    ("indirect", "Indirect", "Irradiance that was reflected at least once", 3),
    ("emitted", "Emitted", "Radiosity of the surface's own emission", 4),
    ("potential", "Potential", "Share of the light emitted here that reaches the chosen receivers; only of the method Potential", 5),
)
DOMAINS = (
    ("POINT", "Vertices", "One value for each vertex: smooth everywhere", 0),
    ("CORNER", "Face Corners", "One value for each corner of each face: hard edges stay hard", 1),
)

DENOISE = (
    ("AUTO", "By Default", "Lightmaps and attributes by path tracing are denoised; other methods and pictures are not", 0),
    ("ON", "On", "Results of all methods that have noise are denoised", 1),
    ("OFF", "Off", "Results are written as they were computed", 2),
)

# The panel starts with the defaults of the command line.
DEFAULT = {f.name: f.default for f in dataclasses.fields(BakeRequest)}

# What a quadrant shows first where it holds several methods: the one that solves the whole equation for any diffuse scene.
PREFERRED = ("path_tracing", "matrix_radiosity", "progressive_radiosity", "particle_tracing")


def quadrant(strategy: str, nature: str) -> str:
    """Name of the property that holds the method chosen in one quadrant of the taxonomy."""
    return f"method_{strategy}_{nature}"


def group_name(method: str) -> str:
    """Name of the property that holds the settings of `method`."""
    return f"settings_{method}"


class Root:
    """The part of the root property group that does not depend on which methods exist."""

    strategy: bpy.props.EnumProperty(
        name="Strategy", description="Which of the two adjoint equations is solved", items=STRATEGIES, default="gathering"
    )
    nature: bpy.props.EnumProperty(name="Nature", description="How the equation is solved", items=NATURES, default="nondeterministic")

    target: bpy.props.EnumProperty(name="Target", description="What the result is written to", items=TARGETS, default=DEFAULT["target"])
    quantity: bpy.props.EnumProperty(name="Quantity", description="Which light is written", items=QUANTITIES, default=DEFAULT["quantity"])
    selection_only: bpy.props.BoolProperty(
        name="Selected Only", description="Bake the selected objects; otherwise every mesh object that is rendered", default=True
    )
    resolution: bpy.props.IntProperty(
        name="Resolution", description="Width and height of each texture", default=DEFAULT["resolution"], min=1, max=16384, soft_max=4096
    )
    atlas: bpy.props.BoolProperty(
        name="One Atlas", description="Pack all objects into one texture instead of one each", default=DEFAULT["atlas"]
    )
    uv_layer: bpy.props.StringProperty(
        name="UV Layer", description="UV layer to bake into; it must not overlap itself. Empty: one is made for the lightmap", default=""
    )
    texels_per_metre: bpy.props.FloatProperty(
        name="Texels per Metre",
        description="Density of lightmaps, as far as the resolution has room; images are only as large as that needs. 0: fill the image",
        default=DEFAULT["texels_per_metre"],
        min=0.0,
        max=MAX_DENSITY,
        soft_max=1000.0,
    )
    margin: bpy.props.IntProperty(
        name="Margin",
        description="Texels by which charts are extended, never into other charts",
        default=DEFAULT["margin"],
        min=0,
        max=16384,
        soft_max=64,
    )
    subsamples: bpy.props.IntProperty(
        name="Points per Texel",
        description="Points of each texel at which its surface is looked up; more make edges smoother",
        default=DEFAULT["subsamples"],
        min=1,
        max=256,
        soft_max=16,
    )
    attribute: bpy.props.StringProperty(
        name="Attribute", description="Name of the color attribute that is written", default=DEFAULT["attribute"]
    )
    domain: bpy.props.EnumProperty(
        name="Domain", description="Where the attribute holds its values", items=DOMAINS, default=DEFAULT["domain"]
    )
    new_object: bpy.props.BoolProperty(
        name="New Object",
        description="Write the attribute to an object of its own, hidden from renders: element methods make it of their elements, so that "
        "walls are subdivided; other methods take the evaluated mesh, as needed when modifiers change the mesh",
        default=DEFAULT["new_object"],
    )
    instances: bpy.props.BoolProperty(
        name="Bake Instances",
        description="Also bake what collection instances, geometry nodes, parents and particles make: each gets an object of its own, "
        "in a collection that is hidden until Show Result and goes with Clear Results",
        default=DEFAULT["instances"],
    )
    denoise: bpy.props.EnumProperty(
        name="Denoise",
        description="Take noise out of the result before it is written; methods without noise never need it",
        items=DENOISE,
        default="AUTO",
    )
    folder: bpy.props.StringProperty(
        name="Folder",
        description="Where EXR files are saved. Empty: the image is kept in the .blend file only",
        default="",
        subtype="DIR_PATH",
        options=FOLDER,
    )
    result: bpy.props.PointerProperty(type=ADJOINTGI_PG_result)


def chosen(scene: bpy.types.Scene) -> Solver | None:
    """The method chosen in `scene`; None where its quadrant holds none."""
    state = scene.adjoint_gi
    id = getattr(state, quadrant(state.strategy, state.nature), "")
    return registry.method(id) if id else None


def own_and_common(solver: Solver) -> tuple[list[str], list[str]]:
    """Names of the settings that only this method has, and of those that every method has."""
    common = {f.name for f in dataclasses.fields(Settings)}
    names = [f.name for f in dataclasses.fields(solver.Settings)]
    return [n for n in names if n not in common], [n for n in ("min_length", "max_length", "seed") if n in names]


def method_label(id: str) -> str:
    """The label of a method; a file may name one that this version does not know."""
    try:
        return registry.method(id).spec.label
    except SettingsError:
        return id


def settings_of(scene: bpy.types.Scene, method: str) -> Settings:
    """The settings of `method` as `scene` has them; raises `SettingsError` where they contradict each other."""
    return fields.values(getattr(scene.adjoint_gi, group_name(method)), registry.method(method).Settings)


def request_of(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer | None = None) -> BakeRequest:
    """What the panel asks for, as the bake understands it; raises `SettingsError` when no method is chosen.

    `view_layer` decides what is selected (the scene's first one by default).
    """
    state, solver = scene.adjoint_gi, chosen(scene)
    if solver is None:
        raise SettingsError("Method", f"no method is both {state.strategy} and {state.nature}", "Choose another strategy or nature")
    layer = view_layer or scene.view_layers[0]
    objects = results.selected(layer, state.instances) if state.selection_only else ()
    if state.selection_only and not objects and state.target != "render":
        raise SettingsError("Selected Only", *results.nothing_selected(layer))
    return BakeRequest(
        method=solver.spec.id,
        settings=settings_of(scene, solver.spec.id),
        target=state.target,
        objects=objects,
        quantity=fitting_quantity(solver, state.quantity),
        resolution=state.resolution,
        atlas=state.atlas,
        uv_layer=state.uv_layer,
        texels_per_metre=state.texels_per_metre,
        margin=state.margin,
        subsamples=state.subsamples,
        attribute=state.attribute,
        domain=state.domain,
        new_object=state.new_object,
        instances=state.instances,
        output=folder_of(scene, state.target),
        denoise=denoises_by_default(solver.spec.id, state.target) if state.denoise == "AUTO" else state.denoise == "ON",
    )


def folder_of(scene: bpy.types.Scene, target: str) -> str:
    """The folder for files as it was typed; empty for an attribute, which only the .blend file holds."""
    return scene.adjoint_gi.folder if target != "attribute" else ""


def _get_method(self: bpy.types.PropertyGroup) -> int:
    """Fixed number of the chosen method, -1 where the quadrant holds none."""
    id = getattr(self, quadrant(self.strategy, self.nature), "")
    return registry.method(id).spec.number if id else -1


def _set_method(self: bpy.types.PropertyGroup, number: int) -> None:
    """Choose a method by its number, in its present quadrant if it is there, else in its first one."""
    spec = next(m.spec for m in registry.methods() if m.spec.number == number)
    if self.strategy not in spec.strategies:
        self.strategy = spec.strategies[0].value
    if self.nature not in spec.natures:
        self.nature = spec.natures[0].value
    setattr(self, quadrant(self.strategy, self.nature), spec.id)


def _items(methods: tuple[Solver, ...]) -> tuple[tuple[str, str, str, int], ...]:
    """Enum items of methods: identifiers and numbers are those of their specs, which never change."""
    return tuple((m.spec.id, m.spec.label, m.spec.idea.rstrip("."), m.spec.number) for m in methods)


def _root_class(groups: dict[str, type]) -> type[bpy.types.PropertyGroup]:
    """The root group: the fixed part, one method menu for each quadrant, one settings group for each method."""
    annotations: dict[str, object] = {}
    for strategy in Strategy:
        for nature in Nature:
            items = _items(registry.fitting(strategy, nature))
            if items:  # an enum without items could hold nothing
                annotations[quadrant(strategy, nature)] = bpy.props.EnumProperty(
                    name="Method",
                    description="Method that solves the scene",
                    items=items,
                    default=next((i[0] for i in items if i[0] in PREFERRED), items[0][0]),
                )
    if registry.methods():
        annotations["method"] = bpy.props.EnumProperty(
            name="Method",
            description="The chosen method, whichever quadrant it is in",
            items=_items(registry.methods()),
            get=_get_method,
            set=_set_method,
        )
    for id, group in groups.items():
        annotations[group_name(id)] = bpy.props.PointerProperty(type=group)
    return type("ADJOINTGI_PG_root", (Root, bpy.types.PropertyGroup), {"__annotations__": annotations, "__doc__": "Adjoint GI"})


_classes: list[type] = []


def register() -> None:
    """Load the methods, make the classes from them and hang the root group on every scene."""
    solvers.load()
    groups = {}
    for m in registry.methods():
        groups[m.spec.id] = fields.group_class(f"ADJOINTGI_PG_{m.spec.id}", m.Settings, m.spec.label)
    _classes.extend([ADJOINTGI_PG_notice, ADJOINTGI_PG_result, *groups.values()])
    for cls in _classes:
        bpy.utils.register_class(cls)
    root = _root_class(groups)
    bpy.utils.register_class(root)
    _classes.append(root)
    bpy.types.Scene.adjoint_gi = bpy.props.PointerProperty(type=root)
    bpy.types.Object.adjoint_gi_density = bpy.props.FloatProperty(
        name="Density",
        description="Texels along an edge of this object in an atlas, beside what it would get by what is seen of it",
        default=1.0,
        min=0.01,
        soft_max=8.0,
    )


def unregister() -> None:
    """Take the root group off the scenes and forget the classes; doing it twice changes nothing."""
    if hasattr(bpy.types.Scene, "adjoint_gi"):
        del bpy.types.Scene.adjoint_gi
        del bpy.types.Object.adjoint_gi_density
    while _classes:
        bpy.utils.unregister_class(_classes.pop())
