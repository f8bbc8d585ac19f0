# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake from Blender's scene to Blender's data and files: the same for the panel, the command line and scripts.

    bake = Bake(context, request)      # refuses, or extracts, places receivers and makes the driver
    bake.driver.run()                  # or start(), stop(), resume() in the background
    bake.write(bake.driver.solution())
    report.of_bake(bake)

Everything here belongs on the main thread; only the driver's own thread computes, on copied arrays.
"""

from __future__ import annotations

import contextlib

import bpy

from ...core.base.errors import AdjointError, Notice
from ...core.method.driver import Driver
from ...core.method.solution import Solution
from ...core.scene.arrays import SceneArrays
from ...core.scene.world import World
from ..extract.depsgraph import extract
from ..host import files
from ..props.request import BakeRequest, raise_first
from . import outputs
from .attributes import AttributeWriter
from .picture import PictureWriter
from .preflight import inspect, look, ordered, picture_size, preflight, receiving
from .textures import TextureWriter
from .writer import Writer

__all__ = ["Bake", "BakeRequest", "preflight"]

WRITERS: dict[str, type[Writer]] = {"texture": TextureWriter, "attribute": AttributeWriter, "render": PictureWriter}


class Bake:
    """See the head of this file.

    notices   everything that was found before the solve and while writing, errors excluded, for they refuse the bake
    written   what `write` has written last: names of datablocks and files
    files     paths of the files among them
    """

    def __init__(self, context: bpy.types.Context, request: BakeRequest) -> None:
        """Raises `AdjointError` with object, reason and remedy when the bake is refused; then nothing has been changed."""
        self.request = request
        self.written: list[str] = []
        self.files: list[str] = []
        self.scene_name = context.scene.name

        # Step 1: refuse what cannot work, before anything is touched.
        notices = look(context, request)
        raise_first(notices)
        arrays = self._extract(context)
        world = World(arrays)
        taken = outputs.problems(request, arrays, receiving(arrays, request), self.scene_name)
        notices = ordered([*notices, *inspect(world, request), *taken])
        raise_first(notices)
        if request.output:
            files.output_folder(request.output)  # only writing there shows whether it can be done

        # Step 2: UV layers that are missing are made; then the scene has to be read again.
        kind = WRITERS[request.target]
        made = kind.prepare(context, request, world)
        with contextlib.ExitStack() as undo:
            if made is not None:
                undo.push(made.undo)
                world = World(self._extract(context))

            # Step 3: receivers and the driver.
            self.writer = kind(context, request, world)
            undo.pop_all()
        said = made.notices if made is not None else ()
        self.notices: list[Notice] = ordered([*(n for n in notices if n.severity != "error"), *said, *self.writer.notices])
        self.driver = Driver(request.solver, world, self.writer.receivers, request.settings)

    def write(self, solution: Solution) -> list[str]:
        """Write `solution` where it was asked for and read it back; returns the names of datablocks and paths of files.

        While the driver runs, only datablocks are refreshed. A partial result is labelled so, in file names too. Raises
        `TargetError` or `WriteError`; where only the files failed, the datablocks are written all the same, and `written` names them.
        """
        live = self.driver.state == "running"
        wanted = not live and (self.request.output or self.writer.needs_folder)
        self.written, self.files, self.writer.notices = [], [], []
        self.writer.is_last = not live
        try:
            folder = files.output_folder(self.request.output) if wanted else None
            datablocks, paths = self.writer.write(solution, folder)
        except AdjointError:
            if wanted:
                with contextlib.suppress(AdjointError):  # the first error is the one that is reported
                    self.written = self.writer.write(solution, None)[0]
            raise
        finally:
            # Once, however often a partial result is written.
            self.notices += [n for n in dict.fromkeys(self.writer.notices) if n not in self.notices]
        self.files = [str(p) for p in paths]
        self.written = [*datablocks, *self.files]
        return self.written

    def _extract(self, context: bpy.types.Context) -> SceneArrays:
        depsgraph = context.evaluated_depsgraph_get()
        return extract(depsgraph, context.scene, picture_size(context.scene, self.request))
