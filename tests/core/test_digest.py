# SPDX-License-Identifier: GPL-3.0-or-later
"""Digests tell values apart, whatever they are made of."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.digest import digest


@dataclass(frozen=True)
class One:
    a: object
    b: object = 0


@dataclass(frozen=True)
class Two:
    a: object
    b: object = 0


DIFFERENT = [
    None,
    False,
    0,
    0.0,
    -0.0,
    1,
    1.0,
    float("nan"),
    "",
    "0",
    b"0",
    (),
    [],
    {},
    set(),
    ("ab", "c"),
    ("a", "bc"),
    (("a",), "b"),
    (("a", "b"),),
    {"a": 1, "b": 2},
    {"b": 2, "a": 1},
    {1, 2},
    {(1, 2)},
    One(1),
    Two(1),
    One(1, 1),
    One((1, 0)),
    np.zeros(2, np.float32),
    np.zeros(4, np.float16),
    np.zeros((2, 1), np.float32),
    np.zeros(2, np.int32),
    np.float32(0),
    np.array([[1, 2], [3, 4]]),
    np.array([[1, 3], [2, 4]]),
    np.array([[1, 2], [3, 4]]).T[::-1],
]


def test_different_values_have_different_digests():
    for a, b in itertools.combinations(range(len(DIFFERENT)), 2):
        assert digest(DIFFERENT[a]) != digest(DIFFERENT[b]), (DIFFERENT[a], DIFFERENT[b])


def test_equal_values_have_the_same_digest():
    a = np.arange(6).reshape(2, 3)
    assert digest(a) == digest(np.asfortranarray(a)) == digest(a[:, ::-1][:, ::-1])
    assert digest({"x", "y", "z"}) == digest({"z", "y", "x"})
    assert digest(One(float("nan"))) == digest(One(float("nan")))
    assert digest("\udcff") == digest("\udcff")


@pytest.mark.parametrize("value", [object(), One(object()), [lambda: 0], np.array([None])])
def test_what_cannot_be_told_apart_is_refused(value):
    with pytest.raises(TypeError):
        digest(value)
