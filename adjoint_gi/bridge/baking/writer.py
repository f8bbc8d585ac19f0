# SPDX-License-Identifier: GPL-3.0-or-later
"""The interface of what a bake is for: receivers before the solve, datablocks and files after it. One subclass for each target."""

from __future__ import annotations

import abc
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ...core.base.errors import Notice, TargetError
from ...core.base.text import json_text
from ...core.denoise.ground import Ground
from ...core.flux.density import Given
from ...core.method.solution import Solution
from ...core.receivers.base import Receivers
from ...core.scene.world import World
from ..host.preparation import Stages
from ..props.request import BakeRequest


@dataclass
class Prepared:
    """What was made on the objects before a bake: what there is to say of it, and what takes it back where the bake is refused later."""

    notices: list[Notice]
    undo: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)


class Writer(abc.ABC):
    """Places the receivers of one bake of `world`, and writes solutions for them.

    receivers   where the solve has to answer
    given       what each object got of the lightmaps, if they are textures
    notices     what was found while placing or writing
    """

    is_last = True  # whether what is written next is the end of the bake, and not shown for the time being
    needs_folder = False  # whether the result is nothing but files

    given: Sequence[Given] = ()
    receivers: Receivers

    def __init__(self, context: bpy.types.Context, request: BakeRequest, world: World) -> None:
        """Without receivers, which `placing` makes. Of `request`, `output` is not read: folders are given to `write`."""
        self.request, self.world = request, world
        self.scene_name = context.scene.name
        self.notices: list[Notice] = []

    @classmethod
    def preparing(cls, request: BakeRequest, world: World, same: Callable[[], None]) -> Stages[Prepared | None]:
        """Make what is missing on the objects before receivers can be placed; returns None when nothing was made.

        Where something was made, the scene has to be read again. `same` raises when the user has changed it since it was read; to be asked
        after every part that runs aside.
        """
        return None
        yield

    @abc.abstractmethod
    def placing(self) -> Stages[None]:
        """Make `receivers`, in an order that `write` knows. Raises `AdjointError` when there is nothing to write to."""

    def ground(self, solution: Solution) -> Ground | None:
        """What a denoiser has to know of the receivers; None where `solution` is not to be denoised."""
        return None

    def seamless(self, solution: Solution) -> Solution:
        """`solution` with the light of receivers that lie beside one another on a surface, but not in an image, brought together."""
        return solution

    @abc.abstractmethod
    def write(self, solution: Solution, folder: Path | None) -> tuple[list[str], list[Path]]:
        """Write datablocks and, where a `folder` is given, files; returns the names of the ones and the paths of the others.

        Raises `TargetError` or `WriteError`.
        """

    def metadata(self, solution: Solution) -> dict[str, str]:
        """What is stored with a result to describe it."""
        return {
            "method": solution.method,
            "quantity": solution.whole if self.request.target == "render" else self.request.quantity,
            "partial": "yes" if solution.partial else "no",
            "seconds": f"{solution.seconds:.3f}",
            "settings": json_text(dict(sorted(solution.settings.items()))),
        }


def find_objects(uids: tuple[int, ...], name: str) -> list[bpy.types.Object]:
    """The objects of these session_uids; raises `TargetError` when one is gone."""
    present = {o.session_uid: o for o in bpy.data.objects}
    if any(uid not in present for uid in uids):
        raise TargetError(name, "was deleted while it was baked", "Bake again")
    return [present[uid] for uid in uids]
