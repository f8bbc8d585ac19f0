# SPDX-License-Identifier: GPL-3.0-or-later
"""Pages and JSON of comparisons, line by line; see `tests/approval.py`, and `tests/compared.py` for how their numbers are reckoned."""

from __future__ import annotations

import dataclasses

import numpy as np
from adjgi.adjoint_gi.core.comparison import page
from adjgi.tests.approval import approve, flat
from adjgi.tests.compared import DIM, disagreeing, pictured, too_few


def lines(result, pictures=None, facts=()):
    """The page without its style and the bytes of its pictures."""
    made = page.page("Hall", result, pictures or {}, [DIM], facts)
    head, _, rest = made.partition("<style>")
    parts = (head + rest.partition("</style>")[2]).split("base64,")
    return ["".join([parts[0], *("BYTES" + part[part.index('"') :] for part in parts[1:])])]


def test_pages_and_json_are_told_as_approved():
    result = disagreeing()
    facts = (("Scene", "Hall"), ("Receivers", "4 texels"))
    told = ["# four methods, equal time", *lines(result, {"histogram": np.zeros((2, 3, 3))}, facts)]
    told += ["", "# its JSON", *flat(page.as_json(result, [DIM]))]
    told += ["", "# equal error, too few repeats", *lines(too_few())]
    told += ["", "# a picture, stopped", *lines(pictured())]
    approve("page", told)


def test_what_is_said_of_the_best():
    error, fast = too_few(), dataclasses.replace(disagreeing(), reference=None)
    nobody = dataclasses.replace(error, entries=tuple(dataclasses.replace(e, state="limit") for e in error.entries))
    blind = dataclasses.replace(fast, entries=tuple(dataclasses.replace(e, error=None) for e in fast.entries))
    rays = dataclasses.replace(fast, budget=dataclasses.replace(fast.budget, kind="rays", value=5e6))
    assert [page.best_text(r) for r in (error, nobody, fast, rays, blind, pictured())] == [
        "Beta was first to reach the error, after 6.66 s.",
        "No method reached the error.",
        "Alpha has the least error at equal time: 2.13 %.",
        "Alpha has the least error at equal rays: 2.13 %.",
        "There is no winner without a reference.",
        "There is no winner, as not all methods have run to their ends.",
    ]
