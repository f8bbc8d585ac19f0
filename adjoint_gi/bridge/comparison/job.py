# SPDX-License-Identifier: GPL-3.0-or-later
"""The one comparison that may run in the background. It writes nothing into the scene before its end, and then its table and pictures as
one undo step."""

from __future__ import annotations

import bpy

from ...core.base.errors import AdjointError, Notice
from ...core.comparison.run import Result
from ..host import background, files
from ..host.prepared import PreparedJob
from . import records
from .files import check_files, write_files
from .request import Compare, CompareRequest


class CompareJob(PreparedJob):
    """One comparison, and the folder for its files."""

    def __init__(self, context: bpy.types.Context, request: CompareRequest) -> None:
        """Raises `AdjointError` when the scene cannot be compared."""
        self.folder = files.output_folder(request.output) if request.output else None
        if self.folder is not None:
            check_files(request, self.folder)
        self.made = Compare(context, request, now=False)
        super().__init__(context.scene.session_uid, self.made.preparing())

    def take_driver(self) -> None:
        """The driver takes the place of what prepared it."""
        self.driver = self.made.driver

    @property
    def complete(self) -> bool:
        """Whether it has ended and its whole result was written."""
        return self.state == "finished" and not self.notices

    def conclude(self, state: str) -> None:
        """Write what there is."""
        self.state = state
        result = self.driver.solution()
        if result is None or not (result.entries or result.refused):
            self.notices = [Notice("", "Stopped before the first result", "", "info")]
            return
        self.write(result)

    def write(self, result: Result) -> None:
        """Table and pictures into the scene that it was started in, and files where a folder is set."""
        scene = self.find_scene()
        paths: list[str] = []
        try:
            if self.folder is not None and result.entries:
                paths = [str(p) for p in write_files(self.made, result, self.folder)]
        except AdjointError as error:  # the scene gets the result all the same
            self.notices = [error.notice]
        try:
            if scene is None:
                raise AdjointError("Scene", "was deleted while methods were compared", "Compare again")
            record = scene.adjoint_gi_compare.result
            records.store(record, result, self.made.notices, paths)
            records.store_pictures(record, self.made.pictures(result))
        except AdjointError as error:
            self.notices = [*self.notices, error.notice]
        if scene is not None:
            background.push_undo("Adjoint GI Comparison")


COMPARISONS = background.Runner("comparison", CompareJob)
