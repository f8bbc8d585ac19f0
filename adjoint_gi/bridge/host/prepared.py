# SPDX-License-Identifier: GPL-3.0-or-later
"""A job whose driver has to be made first: until then `Preparation` stands in its place, and the job goes on from slice to slice."""

from __future__ import annotations

import abc

from ...core.base.errors import AdjointError, Notice
from . import background
from .preparation import Preparation, Stages

QUICK = 0.1  # seconds that pressing the button may take before the job goes on in the background
UNDO = "Adjoint GI Lightmap UVs"  # the undo step of what a preparation has made


class PreparedJob(background.Job):
    """Runs `stages` first, in the scene of session_uid `scene`; `take_driver` then sets the driver that they have made."""

    def __init__(self, scene: int, stages: Stages[None]) -> None:
        self.preparation = Preparation(stages)
        super().__init__(scene, self.preparation)

    @property
    def preparing(self) -> bool:
        """Whether the solve has not begun yet."""
        return self.driver is self.preparation

    @abc.abstractmethod
    def take_driver(self) -> None:
        """Set `driver` to the one that the stages have made."""

    def start(self) -> None:
        """Prepare as far as one slice goes, where quick scenes are refused or ready, and go on by `poll`. Raises `AdjointError`."""
        self._prepare(wait=QUICK)
        if isinstance(self.preparation.error, AdjointError):
            raise self.preparation.error

    def ready(self) -> None:
        """Prepare to the end, here and now, without a thread. Raises `AdjointError`."""
        with background.undo_step_of_additions(UNDO):
            self.preparation.finish()
        self.take_driver()

    def poll(self) -> None:
        """Go on preparing, or look at the driver."""
        if not self.preparing:
            super().poll()
        elif self.state == "stopping":
            self._drop()
        else:
            self._prepare()

    def stop(self, wait: float = background.STOP) -> None:
        """While it is prepared there is no result to keep: what was made is taken back."""
        if self.preparing and self.state == "running":
            self.state = "stopping"
            if wait:
                self._drop(wait)
        else:
            super().stop(wait)

    def cancel(self) -> None:
        """Drop the work."""
        if self.preparing:
            self.preparation.stop(background.STOP)  # without an undo step: a file may be about to be loaded
            self.state = "cancelled"
        else:
            super().cancel()

    def _prepare(self, wait: float = 0.0) -> None:
        """One slice of the preparation; at its end the driver takes its place."""
        with background.undo_step_of_additions(UNDO):
            self.preparation.advance(wait)
        if self.preparation.state == "failed":
            self.fail(self.preparation.error)
            self.notices += getattr(self.preparation.error, "others", ())
        elif self.preparation.state == "finished":
            self.take_driver()
            self.driver.start()

    def _drop(self, wait: float = 0.0) -> None:
        """End the preparation, if its part that runs aside lets go in `wait` seconds."""
        with background.undo_step_of_additions(UNDO):
            if self.preparation.stop(wait):
                self.state = "stopped"
                self.notices = [Notice("", "Stopped before the solve began; nothing was changed", "", "info")]
