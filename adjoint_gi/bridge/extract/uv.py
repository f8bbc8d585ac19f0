"""Texture coordinates: which UV layer an image is looked up with, and the constant affine map in between."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from ..host.versions import group_value_is_place
from .nodes import Place, follow, inputs, is_linked

CHAIN = 32


class NotUv(ValueError):
    """The coordinates are not an affine map of a UV layer; the text says what they are."""


def read_coordinates(vector: Place) -> tuple[str, np.ndarray]:
    """UV layer ("" for the one used in rendering) and (2, 3) float64 map from (u, v, 1) to image coordinates.

    Raises `NotUv` for generated, object, normal and other coordinates.
    """
    affine = np.eye(4)
    place = vector
    for _ in range(CHAIN):
        found = follow(place)
        if not found.socket.is_output:
            of_group = found.socket.node.type == "GROUP"
            if place is vector and not (of_group and group_value_is_place(found.socket)):
                return "", _uv_part(affine)  # an image without coordinates uses the UV layer for rendering
            if not of_group and found.socket != place.socket:
                raise NotUv("has a mapping without texture coordinates")
            return "", _uv_part(affine @ _everywhere(found.socket.default_value))  # one point of the image, as in Cycles
        node = found.socket.node
        if node.type == "MAPPING":
            affine = affine @ _mapping(node, found)
            place = inputs(found)["Vector"]
        elif node.type == "UVMAP":
            if node.from_instancer:
                raise NotUv("uses UV coordinates of the instancer")
            return node.uv_map, _uv_part(affine)
        elif node.type == "TEX_COORD":
            if found.socket.name != "UV" or node.from_instancer:
                raise NotUv(f"uses {found.socket.name.lower()} coordinates")
            return "", _uv_part(affine)
        elif node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY" and found.socket.name == "Vector":
            return node.attribute_name, _uv_part(affine)
        else:
            raise NotUv(f'takes its coordinates from the node "{node.name}" ({node.bl_label})')
    raise NotUv(f"has more than {CHAIN} mappings in a row")


def _uv_part(affine: np.ndarray) -> np.ndarray:
    """(2, 3): the part of a (4, 4) map that concerns points (u, v, 0)."""
    return affine[:2][:, [0, 1, 3]]


def _everywhere(value: float | Sequence[float]) -> np.ndarray:
    """(4, 4) map of every point to the value of a socket (number, vector or colour)."""
    m = np.zeros((4, 4))
    m[:3, 3] = value if isinstance(value, int | float) else tuple(value)[:3]
    m[3, 3] = 1.0
    return m


def _mapping(node: bpy.types.Node, place: Place) -> np.ndarray:
    """(4, 4) of a Mapping node; raises `NotUv` when one of its values is linked or it normalises."""
    sockets = inputs(place)
    values = {"Location": np.zeros(3), "Rotation": np.zeros(3), "Scale": np.ones(3)}
    for name in values:
        if name not in sockets:  # vector and normal types have no location
            continue
        found = follow(sockets[name])
        if found.socket.is_output or is_linked(sockets[name]):
            raise NotUv(f"has a mapping whose {name.lower()} is linked")
        values[name] = np.array(found.socket.default_value, np.float64)
    turn = _rotation(values["Rotation"])
    m = np.eye(4)
    if node.vector_type == "TEXTURE":
        scale = np.where(values["Scale"] != 0.0, values["Scale"], np.inf)
        m[:3, :3] = (turn / scale).T
        m[:3, 3] = -m[:3, :3] @ values["Location"]
    elif node.vector_type in ("POINT", "VECTOR"):
        m[:3, :3] = turn * values["Scale"]
        m[:3, 3] = values["Location"] if node.vector_type == "POINT" else 0.0
    else:
        raise NotUv("has a mapping of type normal")
    return m


def _rotation(euler: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of Euler angles in the order X, Y, Z."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(euler), np.sin(euler)
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return z @ y @ x
