# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands `bake` and `check`."""

from __future__ import annotations

import argparse
import contextlib
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import bpy

from ...core.base.atomic import check_target, replace_file
from ...core.base.errors import AdjointError, MemoryRefused, Notice, SceneError, TargetError, WriteError
from ...core.base.resources import peak_memory, size_text
from ...core.base.text import json_text, plain
from ...core.method.driver import answering
from ...core.method.solution import Solution
from ..baking.bake import Bake, rehearse
from ..baking.report import of_bake
from ..host import files
from ..host.background import notice_of
from ..props.request import BakeRequest
from ..results import kept, stored
from ..results.stored import ABOUT
from .arguments import DONE, FAILED, INTERRUPTED, request_of, use_threads
from .open import open_scene
from .progress import Progress, seconds_text
from .streams import say, say_notices, say_traceback


def bake(options: argparse.Namespace) -> int:
    """Bake, write, report; returns the exit code."""
    use_threads(options.threads)
    request = request_of(options)
    open_scene(options)
    require_place(options, request)
    made = Bake(bpy.context, request)
    say_notices(made.notices)
    failure = solve(made)
    solution = made.driver.solution()
    if isinstance(failure, SceneError | MemoryRefused):
        made.take_back()
        raise failure  # refused by the method once it had looked closely: what there is until then is no result
    if solution is None:
        made.take_back()
        if failure is not None:
            raise failure
        raise KeyboardInterrupt
    known = len(made.notices)
    with uninterrupted():
        written = write_or_keep(made, solution, options.save_blend)
        say_notices(made.notices[known:])
        if options.report:
            say(f"wrote {write_report(options.report, of_bake(made))}")
    if not written:
        return FAILED
    say(summary(made))
    if failure is not None:
        if isinstance(failure, AdjointError):
            say_notices([failure.notice])
        else:
            say_notices([Notice("Solver", f"failed with {type(failure).__name__}: {failure}", "The partial result was written", "error")])
        return FAILED
    return INTERRUPTED if solution.partial else DONE


def check(options: argparse.Namespace) -> int:
    """Say everything that pre-flight finds; 2 when the bake would be refused."""
    request = request_of(options)
    open_scene(options)
    notices = rehearse(bpy.context, request)
    for notice in notices:
        say(f"{notice.severity}: {notice}")
    errors, warnings = (sum(n.severity == kind for n in notices) for kind in ("error", "warning"))
    say(f"{errors} error{'s' * (errors != 1)}, {warnings} warning{'s' * (warnings != 1)}")
    return 2 if errors else 0


def solve(made: Bake) -> BaseException | None:
    """Run the driver with a progress line; returns what the solver raised."""
    progress = Progress(made.driver.solver.spec.label)
    try:
        made.driver.run(progress)
    except KeyboardInterrupt:
        raise
    except Exception as error:
        return error
    finally:
        progress.end()
    return None


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Let what is being written be written to its end: the first interruption is only said, a second one interrupts."""
    came = threading.Event()

    def interrupt(*_: object) -> None:
        if came.is_set():
            raise KeyboardInterrupt
        came.set()
        say("interrupted while the result is written, which goes on", error=True)

    with answering(interrupt):
        yield


def write_or_keep(made: Bake, solution: Solution, blend: str | None) -> bool:
    """`write`; where that fails, keep the result as a file. Both stand in the notices of `made`. Returns whether all of it was written."""
    try:
        write(made, solution, blend)
    except Exception as error:  # whatever it was: the work is not lost
        if not isinstance(error, AdjointError | OSError):
            say_traceback()
        made.notices.append(notice_of(error))
        try:
            made.notices.append(Notice("Result", f"is kept in {kept.save(solution)}", "Read it with numpy.load", "warning"))
        except AdjointError as second:
            made.notices.append(second.notice)
        return False
    return True


def write(made: Bake, solution: Solution, blend: str | None) -> None:
    """Write the result, and save the scene with it as `blend`; raises `AdjointError` when not all of it was written.

    Where only files could not be written the scene holds the result all the same, so it is saved.
    """
    problem = None
    try:
        made.write(solution)
    except AdjointError as error:
        problem = error
    if blend and (made.written or problem is None):
        if hasattr(bpy.types.Scene, "adjoint_gi"):  # a script may call this without the extension
            made.remember(bpy.context.scene, solution, [*([problem.notice] if problem else []), *made.notices], made.files)
        made.files.append(save_blend(files.absolute(blend)))
        made.written.append(made.files[-1])
    if blend or problem is None:
        for name in made.written:
            say(f"wrote {name}")
    if problem is not None:
        raise problem


def summary(made: Bake) -> str:
    """The last line: what, how long, how many rays, how much memory."""
    driver, solution = made.driver, made.driver.solution()
    state = "partial result" if solution.partial else "finished"
    text = f"{state}: {driver.solver.spec.id} to {made.request.target}, {seconds_text(solution.seconds)}, {int(solution.rays):,} rays"
    if solution.balance is not None:
        text += f", energy gap {plain(100 * solution.balance.gap)} %"
    peak = peak_memory()
    return text + (f", peak memory {size_text(peak)}" if peak is not None else "")


def require_place(options: argparse.Namespace, request: BakeRequest) -> None:
    """Refuse, before any work, a bake whose result would be lost or could not be written."""
    if request.target == "render" and not request.output:
        raise TargetError("--output", "is missing", "Give a folder for the picture")
    if request.target == "texture" and not request.output and not options.save_blend:
        raise TargetError(
            "--output", "is missing, so the lightmaps would be lost", "Give a folder, or save the scene with --save-blend FILE"
        )
    if request.target == "attribute" and not options.save_blend:
        raise TargetError("--save-blend", "is missing, and only a .blend file holds an attribute", "Give --save-blend FILE")
    if options.save_blend:
        require_blend(files.absolute(options.save_blend), options.overwrite)
    if options.report:
        path = files.absolute(options.report)
        if not path.parent.is_dir():
            raise TargetError(str(path), "is in a folder that does not exist", "Make the folder, or choose another")
        check_target(path, path.parent, is_report)
    if request.output:
        files.output_folder(request.output)


def require_blend(path: Path, overwrite: bool) -> None:
    """Raise `TargetError` unless `path` may be written: a new file, or any with `overwrite`."""
    if path.suffix != ".blend":
        raise TargetError(str(path), "does not end in .blend", "Choose another name")
    if not path.parent.is_dir():
        raise TargetError(str(path), "is in a folder that does not exist", "Make the folder, or choose another")
    if path.is_symlink() or (path.exists() and not overwrite):
        raise TargetError(str(path), "exists and is not replaced", "Choose another name, or add --overwrite")


def save_blend(path: Path) -> str:
    """Save the open file as `path`, once a copy beside it was looked into for the results; raises `WriteError` when one is missing, and a
    file that is there already stays then."""
    path = files.absolute(path)
    missing: list[str] = []

    def verify(copy: Path) -> bool:
        missing[:] = _missing(copy)
        return not missing

    try:
        replace_file(path, path.parent, write=_save_copy, verify=verify, ours=lambda _: True)
    except WriteError:
        if missing:
            raise WriteError(str(path), f"does not hold {', '.join(missing)}", "Check the disk and try again") from None
        raise
    return str(path)


def _save_copy(path: Path) -> None:
    path.unlink()  # else Blender keeps it as an earlier version
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, check_existing=False)


def _missing(path: Path) -> list[str]:
    """Names of the results that a .blend file should hold and does not: Blender saves neither what nothing uses nor what belongs to
    another file."""
    with bpy.data.libraries.load(str(path)) as (inside, _):
        held = {kind: set(getattr(inside, kind)) for kind in ("images", "meshes")}
    wanted = ((kind, block) for kind in held for block in getattr(bpy.data, kind) if block.users and block.library is None)
    return sorted(block.name for kind, block in wanted if stored.read(block, ABOUT) is not None and block.name not in held[kind])


def write_report(path: str | Path, report: dict) -> Path:
    """Write `report` as JSON; raises `TargetError` where a file is that is no report."""
    path = files.absolute(path)
    data = json_text(report, indent=1).encode()
    return replace_file(
        path, path.parent, write=lambda p: _put(p, data), verify=lambda p: p.read_bytes() == data and is_report(p), ours=is_report
    )


def is_report(path: Path) -> bool:
    """Whether a file is a report of ours."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return isinstance(found, dict) and "format" in found and "adjoint_gi" in found.get("versions", {})
    except (OSError, ValueError):
        return False


def _put(path: Path, data: bytes) -> None:
    with open(path, "wb") as file:
        file.write(data)
