# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake from Blender's scene to Blender's data and files: the same for the panel, the command line and scripts.

    bake = Bake(context, request)      # refuses, or extracts, places receivers and makes the driver
    rehearse(context, request)         # what the same would say, without leaving anything behind
    bake.driver.run()                  # or start(), stop(), resume() in the background
    bake.write(bake.driver.solution())
    report.of_bake(bake)

Everything here belongs on the main thread; only the driver's own thread computes, on copied arrays.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import bpy
import numpy as np

from ...core.base.errors import AdjointError, Notice, SceneError, TargetError, raise_all
from ...core.flux.density import Given
from ...core.method.driver import Driver
from ...core.method.solution import Solution
from ...core.scene.arrays import SceneArrays
from ..extract.depsgraph import extracting
from ..extract.images import reading, return_images
from ..extract.scene_store import SCENES
from ..host import files
from ..host.preparation import Aside, Stages, finish_stages, once
from ..props import records
from ..props.request import BakeRequest, raise_first
from . import outputs
from .attributes import AttributeWriter
from .denoising import denoise
from .instances import Real, make
from .picture import PictureWriter
from .preflight import checker, inspecting, left_out, ordered, picture_size, preflight, receiving, resolve, target_objects
from .promises import fulfilled
from .textures import TextureWriter
from .watch import unchanged
from .writer import Writer

__all__ = ["Bake", "BakeRequest", "preflight"]

WRITERS: dict[str, type[Writer]] = {"texture": TextureWriter, "attribute": AttributeWriter, "render": PictureWriter}


class Bake:
    """See the head of this file.

    notices   everything that was found before the solve and while writing, errors excluded, for they refuse the bake
    written   what `write` has written last: names of datablocks and files
    files     paths of the files among them
    """

    def __init__(self, context: bpy.types.Context, request: BakeRequest, now: bool = True) -> None:
        """Raises `AdjointError` with object, reason and remedy when the bake is refused; then nothing has been changed.

        Without `now` only what can be seen at once is looked at, and the caller has to run `preparing` before anything else.
        """
        self.request = request
        self.written: list[str] = []
        self.files: list[str] = []
        self.notices: list[Notice] = []
        self.scene_name = context.scene.name
        self._undo = contextlib.ExitStack()
        if now:
            finish_stages(self.preparing())
        else:
            raise_first(resolve(context, request)[1])

    def preparing(self) -> Stages[None]:
        """Extract, check, make what is missing, place the receivers and make the driver.

        Raises as the class does, and when the user changes the scene meanwhile; what was made on the objects is taken back then, and when
        it is closed.
        """
        try:
            built = yield from building(self.request, said := [])
        finally:
            return_images()
        self._undo, self._real = built.undo, built.real
        self.request, self.writer, self.driver = built.writer.request, built.writer, built.driver
        self.notices = [n for n in ordered(said) if n.severity != "error"]

    @property
    def given(self) -> Sequence[Given]:
        """What each object got of the lightmaps; empty for other targets."""
        return self.writer.given

    def take_back(self) -> None:
        """Remove what was made on the objects for a bake that is refused or ends without a result; after a `write` it stays."""
        self._undo.close()

    def keep(self) -> None:
        """What was made on the objects stays from now on, and what it has replaced goes."""
        self._undo.pop_all()
        self._real.settle()

    def remember(
        self, scene: bpy.types.Scene, solution: Solution, notices: Sequence[Notice], files: Sequence[str], applied: bool = True
    ) -> None:
        """Note on `scene` the numbers of `solution`, what is said of it, and where it is: in `files`, and if `applied` on its objects."""
        what = {name: getattr(self.request, name) for name in ("target", "quantity", "new_object")}
        said = dict.fromkeys([*notices, *solution.warnings])
        records.store(scene.adjoint_gi.result, solution, **what, applied=applied, files=files, notices=said, given=self.given)

    def write(self, solution: Solution) -> list[str]:
        """Write `solution` where it was asked for and read it back; returns the names of datablocks and paths of files.

        While the driver runs, only datablocks are refreshed. A partial result is labelled so, in file names too. Raises
        `TargetError` or `WriteError`; where only the files failed, the datablocks are written all the same, and `written` names them.
        """
        self.keep()
        live = self.driver.state == "running"
        wanted = not live and (self.request.output or self.writer.needs_folder)
        self.written, self.files, self.writer.notices = [], [], []
        self.writer.is_last = not live
        try:
            folder = files.output_folder(self.request.output) if wanted else None
            if not live:
                solution, self.writer.notices = denoise(self.request, self.writer, solution)
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


@dataclass
class Built:
    """All of a bake but the solve; `undo` takes back what was made on the objects."""

    writer: Writer
    driver: Driver
    undo: contextlib.ExitStack
    real: Real


def building(request: BakeRequest, said: list[Notice]) -> Stages[Built]:
    """Everything before the solve; notices are added to `said`. Raises `AdjointError` when the bake is refused; then nothing has changed.

    Where no objects are named, one that turns out not to be able to receive is left out, with a warning, and the rest is built.
    """
    told: list[Notice] = []
    while True:
        notices: list[Notice] = []
        made: dict[str, str] = {}
        try:
            built = yield from _attempting(request, notices, made)
        except (SceneError, TargetError) as error:
            context = bpy.context
            objects = [o.name for o in target_objects(context, request)] if request.target != "render" and not request.objects else []
            refused = [error.notice, *error.others]
            names, objects = {made.get(n.object, n.object): None for n in refused}, {*objects, *made.values()}
            if request.objects or not names.keys() <= objects or objects <= names.keys() or names.keys() & set(request.left_out):
                said += [*told, *notices]
                raise
            told += [left_out(n) for n in refused]
            request = replace(request, left_out=(*request.left_out, *names))
            continue
        said += [*told, *notices]
        return built


def _attempting(request: BakeRequest, said: list[Notice], names: dict[str, str]) -> Stages[Built]:
    """`building` for these objects; raises `AdjointError` when one of them cannot receive.

    `names` gets the names of objects made of instances and curves, which are gone then, with what to leave out instead of each.
    """
    # Step 1: refuse what cannot work, before anything is touched.
    request, notices = resolve(bpy.context, request)
    said += notices
    raise_first(notices)
    yield from reading(bpy.context)
    yield "Reading the scene"
    with contextlib.ExitStack() as undo:
        real = make(bpy.context, request)
        undo.push(real.undo)
        names.update(real.left_out)
        said[:] = [*real.fitting(notices), *real.notices, *_checked(real, request)]
        arrays, same = yield from _extracting(request, real)
        said[:] = fulfilled(said, arrays, receiving(arrays, request))
        world = yield Aside("Building the tree of rays", once(lambda: SCENES.world(arrays)))
        same()
        found = yield from inspecting(world, request)
        same()
        found = [*found, *outputs.problems(request, arrays, receiving(arrays, request), bpy.context.scene.name)]
        said += found
        raise_first(ordered(found))
        if request.output:
            files.output_folder(request.output)  # only writing there shows whether it can be done

        # Step 2: UV layers that are missing are made; then the scene has to be read again.
        yield "Checking the objects"
        kind = WRITERS[request.target]
        made = yield from kind.preparing(request, world, same)
        if made is not None:
            undo.callback(lambda: bpy.context.view_layer.update())
            undo.push(made.undo)
            said += made.notices
            yield "Reading the scene again"
            arrays, same = yield from _extracting(request, real)
            world = yield Aside("Building the tree of rays", once(lambda: SCENES.world(arrays)))
            same()

        # Step 3: receivers and the driver.
        yield "Checking the objects"
        writer = kind(bpy.context, request, world)
        yield from writer.placing()
        same()
        said += writer.notices
        return Built(writer, Driver(request.solver, world, writer.receivers, request.settings), undo.pop_all(), real)


def rehearse(context: bpy.types.Context, request: BakeRequest) -> list[Notice]:
    """All that a bake would say before its first result, errors first. All of it is done, by the same code, and taken back."""
    said: list[Notice] = []
    try:
        try:
            built = finish_stages(building(request, said))
        finally:
            return_images()
        with built.undo:
            _first_step(built.driver)
    except AdjointError as error:
        said += [n for n in (error.notice, *error.others) if n not in said]
    return ordered(said)


def _first_step(driver: Driver) -> None:
    """Let the method look closely at the scene; raises what refuses the bake then: memory, or a scene that has no solution."""
    rng = np.random.default_rng(driver.settings.seed)
    steps = driver.solver.solve(driver.world, driver.receivers, driver.settings, rng)
    with contextlib.closing(steps), contextlib.suppress(StopIteration):
        next(steps)


def _checked(real: Real, request: BakeRequest) -> list[Notice]:
    """What is said of the objects that were made; raises `TargetError` for one that cannot receive."""
    check = checker(request, list(real.objects.values()))
    found = [n for obj in real.objects.values() for n in check(obj)]
    raise_all([n for n in found if n.severity == "error"], TargetError)
    return found


def _extracting(request: BakeRequest, real: Real) -> Stages[tuple[SceneArrays, Callable[[], None]]]:
    """The scene as it is, and what raises when it is another one later."""
    context = bpy.context
    same = unchanged()
    size = picture_size(context.scene, request)
    arrays = yield from extracting(size, real.objects)
    same()
    return arrays, same
