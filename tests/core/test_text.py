# SPDX-License-Identifier: GPL-3.0-or-later
"""Text for terminals and strict JSON."""

import json

import pytest
from adjgi.adjoint_gi.core.base.errors import AdjointError, Notice
from adjgi.adjoint_gi.core.base.text import json_text, plain, printable

FORGED = [
    ("a\x1b[31mred", "a\\x1b[31mred"),
    ("a\nerror: forged", "a\\nerror: forged"),
    ("a\rerror: forged", "a\\rerror: forged"),
    ("a\x9b2J\x7f\x00", "a\\x9b2J\\x7f\\x00"),
    ("a\u202eb\u2066c\u200fd", "a\\u202eb\\u2066c\\u200fd"),
    ("a\u2028b\x85c\x0bd", "a\\u2028b\\x85c\\x0bd"),
    ("a\udc80", "a\\udc80"),
]


@pytest.mark.parametrize(
    ("x", "shown"), [(100.0, "100"), (99.6, "100"), (1234.5, "1234"), (99.4, "99"), (0.0123, "0.012"), (-250.0, "-250"), (1e-9, "1e-09")]
)
def test_large_numbers_have_no_exponent(x, shown):
    assert plain(x) == shown
    assert plain(abs(x), 3, "+")[0] == "+"


@pytest.mark.parametrize(("name", "shown"), FORGED)
def test_what_a_terminal_would_obey_is_shown_as_an_escape(name, shown):
    assert printable(name) == shown
    assert str(Notice(name, "is bad", "Go")) == f"{shown}: is bad. Go"
    assert str(AdjointError("A", name)) == f"A: {shown}"
    assert len(shown.splitlines()) == 1


@pytest.mark.parametrize("name", ["Cube.001", "Sm\xf6rg\xe5s \u5bb6 \U0001f3e0", "\u0646\u0645\u06cc\u200c\u062e\u0648\u0627\u0647\u0645"])
def test_names_of_every_script_are_left_as_they_are(name):
    assert printable(name) == name


def test_json_is_strict_and_says_what_null_stands_for():
    inf = float("inf")
    text = json_text({"a": [1.5, (inf, -inf)], "b": {"c": float("nan"), "d": None}, "e": "\x1b"})
    found = json.loads(text, parse_constant=pytest.fail)
    assert found["a"] == [1.5, [None, None]] and found["b"] == {"c": None, "d": None} and found["e"] == "\x1b"
    assert found["not_numbers"] == {"a[1][0]": "infinity", "a[1][1]": "minus infinity", "b.c": "not a number"}
    assert json.loads(json_text({"a": 1.0})) == {"a": 1.0}
    assert json_text([inf]) == "[null]"
