# SPDX-License-Identifier: GPL-3.0-or-later
"""The command `compare`: methods on one scene with one budget, as a page, JSON and pictures."""

from __future__ import annotations

import argparse
from pathlib import Path

import bpy

from ...core.base.errors import AdjointError, Notice, TargetError
from ...core.comparison.budget import STATES
from ...core.comparison.page import best_text, percent
from ...core.comparison.run import Result
from ..comparison.arguments import request_of
from ..comparison.files import check_files, keep_files, write_files
from ..comparison.request import Compare
from ..host import files
from .arguments import DONE, FAILED, INTERRUPTED, use_threads
from .open import open_scene
from .progress import Progress, seconds_text
from .streams import say, say_notices


def compare(options: argparse.Namespace) -> int:
    """Compare, write, print the best method; 0 only when everything was written and read back."""
    use_threads(options.threads)
    request = request_of(options)
    open_scene(options)
    folder = files.output_folder(request.output)
    check_files(request, folder)
    made = Compare(bpy.context, request)
    say_notices(made.notices)
    progress = Progress("Comparison")
    try:
        made.driver.run(progress)
    finally:
        progress.end()
    result = made.driver.solution()
    if result is None or not result.entries:
        say_notices(result.refused if result is not None else ())
        if made.driver.state != "finished":
            raise KeyboardInterrupt
        raise TargetError("Comparison", "no method took part", "Choose others, or see the reasons above")
    written = _write_or_keep(made, result, folder)
    for line in table(result):
        say(line)
    if not written:
        return FAILED
    if result.partial:
        return INTERRUPTED
    # A method that could not take part is a result; one that crashed is not.
    return FAILED if any(n.severity == "error" for n in result.refused) else DONE


def _write_or_keep(made: Compare, result: Result, folder: Path) -> bool:
    """Write the files and say so; where they cannot be, into a folder of our own. Returns whether they are where they were wanted."""
    paths, problem = [], None
    try:
        paths = write_files(made, result, folder)
    except AdjointError as error:
        problem = error
        say_notices([error.notice])
        try:
            paths = keep_files(made, result)
            say_notices([Notice("Result", f"is kept in {paths[0].parent}", "", "warning")])
        except AdjointError as second:  # its table is still printed
            say_notices([second.notice])
    for path in paths:
        say(f"wrote {path}")
    return problem is None


def table(result: Result) -> list[str]:
    """The result in plain text: one line a method, which is best, which disagree."""
    lines = [f"{'method':<26} {'error':>10} {'seconds':>9} {'rays':>14}  run"]
    for e in sorted(result.entries, key=lambda e: e.error if e.error is not None else float("inf")):
        state = STATES[e.state] + ("" if e.complete else ", partial result")
        lines.append(f"{e.method:<26} {percent(e.error):>10} {seconds_text(e.seconds):>9} {e.rays:>14,}  {state}")
    lines += [f"not compared: {n}" for n in result.refused]
    lines.append(best_text(result))
    lines += result.agreement.lines if result.agreement is not None else ()
    if result.partial:
        lines.append("The comparison was stopped before its end: what was written is a partial result.")
    return lines
