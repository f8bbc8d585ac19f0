"""Layers that materials ask for and objects do not have: nothing is black without a word."""

from __future__ import annotations

import bpy
import numpy as np

from ...core.scene.arrays import Material, ObjectArrays
from ..host.notices import Notices


def name_missing_layers(
    objects: tuple[ObjectArrays, ...], object: np.ndarray, material: np.ndarray, materials: tuple[Material, ...], notices: Notices
) -> None:
    """A notice for every object whose material reads a UV layer or colour attribute that the object lacks.

    `object` and `material` are (nt,) int32 per triangle. The value that is computed with is 0, as in Cycles.
    """
    asked = {i: _layers(m) for i, m in enumerate(materials)}
    reading = np.array([bool(asked[i]) for i in range(len(materials))] or [False])
    which = reading[material] if len(material) else np.zeros(0, bool)
    pairs = np.unique(object[which].astype(np.int64) * max(len(materials), 1) + material[which])
    for o, m in zip((pairs // max(len(materials), 1)).tolist(), (pairs % max(len(materials), 1)).tolist(), strict=True):
        owner = objects[o]
        for kind, name in asked[m]:
            if kind == "image" and (name or owner.render_uv) not in owner.uvs:
                layer = f'UV layer "{name}"' if name else "UV layer"
                notices.add(owner.source, f'has no {layer} for the images of material "{materials[m].name}"', "Unwrap it")
            elif kind == "attribute" and name not in owner.colors:
                layer = f'attribute "{name}" of colours, numbers or vectors on points, corners or faces' if name else "colour attribute"
                notices.add(owner.source, f'has no {layer} for material "{materials[m].name}"; it counts as black', "Add the attribute")


def attributes_read() -> frozenset[str]:
    """Names of the attributes that any material of the file reads."""
    trees = [m.node_tree for m in bpy.data.materials if m.node_tree is not None] + list(bpy.data.node_groups)
    nodes = [n for tree in trees for n in tree.nodes if n.type in ("ATTRIBUTE", "VERTEX_COLOR")]
    return frozenset(n.attribute_name if n.type == "ATTRIBUTE" else n.layer_name for n in nodes)


def _layers(material: Material) -> set[tuple[str, str]]:
    """(kind, name) of all sources of a material."""
    return {(s.kind, s.name) for lobe in material.lobes for t in lobe.color.terms for s in t.sources}
