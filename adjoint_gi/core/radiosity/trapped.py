# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that can never leave: closed rooms that reflect everything have no finite radiosity, and methods say so instead of going on."""

from __future__ import annotations

import numpy as np

from ..base.errors import SceneError
from ..elements.elements import Elements
from .southwell import DiffuseShooting
from .transports import MatrixTransport

ROUNDS = 4.0  # times that the unshot light of a channel is sent before its losses are judged
LOSS = 1e-4  # share of what is sent that must be absorbed or escape


def trapped(transport: MatrixTransport) -> np.ndarray:
    """(n,) bool: sides from which light can never leave, because all it can reach has albedo 1 in some channel."""
    out = np.zeros(len(transport.area), bool)
    for c in range(3):
        factors, sky = (transport.factors[c], transport.sky[:, c]) if transport.tinted else (transport.factors, transport.sky)
        loses = (transport.rho[:, c] < 1) | (sky > 1e-9)
        if transport.tinted:  # on the way
            loses |= factors.sum(axis=1) + sky < 1 - 1e-9
        while True:
            more = loses | (factors @ loses > 1e-12)
            if (more == loses).all():
                break
            loses = more
        out |= ~loses
    return out


class Trap:
    """Watches shooting: light that is sent on and on and loses next to nothing is caught."""

    def __init__(self, state: DiffuseShooting) -> None:
        self.state = state
        self._sent, self._lost = state.sent.copy(), state.absorbed + state.escaped

    def check(self, elements: Elements) -> None:
        """Look at what has been sent since the last look that saw enough. Raises SceneError where light is caught."""
        state = self.state
        if state.overshoot:  # sends light that it takes back later, so losses mean nothing
            return
        sent, lost = state.sent - self._sent, state.absorbed + state.escaped - self._lost
        left = state.remaining() - state.cut
        due = (left > 0) & (sent > ROUNDS * left)
        caught = due & (lost < LOSS * sent)
        if caught.any():
            channel = int(np.flatnonzero(caught)[0])
            side = int(np.argmax(state.transport.area * state.unshot[:, :, channel].sum(axis=0)))
            refuse(elements, side)
        self._sent, self._lost = self._sent + due * sent, self._lost + due * lost


def refuse_trapped(elements: Elements, sides: np.ndarray, transport: MatrixTransport) -> None:
    """Raises SceneError where light cannot leave one of the element sides `sides` (n,) of the transport."""
    caught = np.flatnonzero(trapped(transport))
    if len(caught):
        refuse(elements, int(sides[caught[0]]))


def refuse(elements: Elements, side: int) -> None:
    """Raises SceneError for the material of an element side that light cannot leave."""
    scene = elements.world.scene
    triangle = elements.patch_triangle[elements.patch[side >> 1]]
    name = scene.materials[scene.material[triangle]].name
    reason = "reflects all light (albedo 1) where no light can leave, so the radiosity has no limit"
    raise SceneError(f"Material {name}", reason, "Lower its colour below 1, or choose path tracing with a bounded path length")
