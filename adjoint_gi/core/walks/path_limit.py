"""The longest path of a walk, and an estimate of the light that longer ones would bring.

Light of k segments falls about as q^k once k is large. `Tail` adds it up over two blocks of lengths that lie side by side below the limit;
with their sums a and b the rest is that of a geometric series, b r / (1 - r) with r = b / a.
"""

from __future__ import annotations

import numpy as np

from ..base.errors import Notice
from ..base.settings import NO_LIMIT
from ..method.solution import EnergyBalance

LONGEST = 4096  # segments at which walks end that nothing else ends, as in a closed room of albedo 1
FAINT = np.float32(1e-6)  # weight below which paths end where roulette is off and length has no limit
STEEPEST = 0.999  # light that falls less from one block to the next is taken as falling by this
TOLD = 1e-3  # share of the light that is worth a notice


def longest(max_length: int) -> int:
    """Segments of the longest path for a setting of `max_length`."""
    return max_length if max_length < NO_LIMIT else LONGEST


def block_length(min_length: int, max_length: int) -> int:
    """How many lengths each of the two blocks below the limit has; 0 where fewer than two lengths count."""
    count = longest(max_length) - max(min_length, 1) + 1
    return max(1, count // 4) if count >= 2 else 0


def block_of(length: int, min_length: int, max_length: int) -> int | None:
    """0 or 1 for the block that paths of `length` belong to, None for none."""
    below = longest(max_length) - length
    each = block_length(min_length, max_length)
    return None if not 0 <= below < 2 * each else 1 - below // each


def left_out(tail: np.ndarray, total: float) -> float:
    """The share of all light that paths beyond the limit would bring, for sums `tail` (2,) over the blocks and `total` over all lengths.

    0 where no path came near the limit.
    """
    a, b = (float(x) for x in tail)
    if not (a > 0 and b > 0 and total > 0):
        return 0.0
    r = min(b / a, STEEPEST)
    rest = b * r / (1 - r)
    return rest / (total + rest)


def left_unshot(balance: EnergyBalance | None, max_length: int) -> float | None:
    """The same for methods that know the flux that is left at the limit, as if none of it escaped."""
    if max_length >= NO_LIMIT:
        return 0.0
    if balance is None or not balance.absorbed + balance.unshot > 0:
        return None
    return max(balance.unshot, 0.0) / (balance.absorbed + balance.unshot)


def notices(share: float | None, max_length: int) -> tuple[Notice, ...]:
    """What a result says of a `share` that is left out."""
    if share is None or share < TOLD:
        return ()
    part = f"about {share:.1%}" if share < 0.1 else f"about {share:.0%}" if share < 0.9 else "most"
    text = f"paths of more than {longest(max_length)} segments are left out: {part} of the light, by how it falls with length"
    if max_length < NO_LIMIT:
        return (Notice("Path Length", text, f"Set Max Path Length (max_length) to {NO_LIMIT}, which is no limit"),)
    return (Notice("Path Length", text, "Lower albedos that are close to 1: light in closed white rooms does not come to an end"),)
