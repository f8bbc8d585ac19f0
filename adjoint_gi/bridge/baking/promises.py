# SPDX-License-Identifier: GPL-3.0-or-later
"""What is said of an object before the scene was read: what a bake makes for it, if it receives."""

from __future__ import annotations

from collections.abc import Sequence

import bpy

from ...core.base.errors import Notice
from ...core.scene.arrays import SceneArrays

SEPARATE = "its result goes to an object of its own, as New Object does it"  # words about an attribute that the mesh cannot hold
WILL_BE_MADE = (SEPARATE, "; one is made", "; they are made anew", "of the result gets a number")


def fulfilled(notices: Sequence[Notice], arrays: SceneArrays, receivers: Sequence[int]) -> list[Notice]:
    """`notices` without what would be made for objects that turn out not to be among `receivers` (indices): they are told why elsewhere."""
    uids = {arrays.objects[i].uid for i in receivers}
    able = {o.name for o in bpy.data.objects if o.session_uid in uids}
    out: list[Notice] = []
    for n in notices:
        if any(words in n.reason for words in WILL_BE_MADE):
            out += [Notice(name, n.reason, n.remedy, n.severity) for name in n.names or (n.object,) if name in able]
        else:
            out.append(n)
    return out
