"""The scene that was extracted last, kept with its tree of rays as long as Blender says the same of it.

Pressing Bake extracts the scene that the panel has just checked, and baking again that of the last bake. Blender is asked every time: much
that changes in a file gives no sign, so nothing but equal answers shows that nothing has changed. All that is computed of the
answers is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import bpy

from ...core.base.steps import Steps
from ...core.scene.arrays import SceneArrays
from ...core.scene.world import World
from ..host import background

MOST = 1 << 30  # bytes that may be kept
BYTES_A_TRIANGLE = 900  # arrays, rows of the world and Embree's tree, measured on zdm2


@dataclass(eq=False)
class Kept:
    """A scene, the digest of what Blender said of it, and its world once it was made."""

    key: bytes
    arrays: SceneArrays
    world: World | None = None


class SceneStore:
    """Holds one scene at most."""

    def __init__(self) -> None:
        self._kept: Kept | None = None

    def arranged(self, key: Callable[[], bytes], arranging: Callable[[], Steps[SceneArrays]]) -> Steps[SceneArrays]:
        """The arrays for `key`, which is computed aside, too: those that are kept, or else by `arranging`, and kept if they may."""
        yield 0.0
        now, kept = key(), self._kept
        if kept is not None and kept.key == now:
            return kept.arrays
        self._kept = None
        arrays = yield from arranging()
        if needed(arrays) <= MOST:
            self._kept = Kept(now, arrays)
        return arrays

    def world(self, arrays: SceneArrays) -> World:
        """The world of `arrays`: that which is kept, or a new one. Needs no Blender."""
        kept = self._kept
        if kept is None or kept.arrays is not arrays:
            return World(arrays)
        kept.world = kept.world or World(arrays)
        return kept.world

    def clear(self) -> None:
        """Forget it."""
        self._kept = None


SCENES = SceneStore()


def needed(arrays: SceneArrays) -> int:
    """About how many bytes a scene takes with its world."""
    return BYTES_A_TRIANGLE * len(arrays.triangles) + sum(texture.stored.nbytes for texture in arrays.textures)


@bpy.app.handlers.persistent
def _before_load(*_: object) -> None:
    SCENES.clear()


HANDLERS = (("load_pre", _before_load),)


def register() -> None:
    """Forget the scene when another file is loaded."""
    background.listen(HANDLERS)


def unregister() -> None:
    """Forget it; doing it twice changes nothing."""
    background.stop_listening(HANDLERS)
    SCENES.clear()
