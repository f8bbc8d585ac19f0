# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings: parsing, bounds, and messages that name the field and say what to do."""

from __future__ import annotations

import dataclasses
import json

import pytest
from adjgi import solvers
from adjgi.adjoint_gi.core.base.errors import SettingsError
from adjgi.adjoint_gi.core.base.settings import Settings, field_type, setting
from adjgi.adjoint_gi.core.method import registry

solvers.load()


@dataclasses.dataclass(frozen=True)
class Example(Settings):
    share: float = setting(0.5, label="Share", help="A share", min=0.0, max=1.0)
    fast: bool = setting(True, label="Fast", help="Whether")
    kind: str = setting("a", label="Kind", help="Which", choices=(("a", "A", "First"), ("b", "B", "Second")))


def test_texts_become_the_type_of_their_field():
    s = Example().replaced({"seed": "7", "share": "0.25", "fast": "off", "kind": "b"})
    assert (s.seed, s.share, s.fast, s.kind) == (7, 0.25, False, "b")
    assert Example().replaced({"share": 1}).share == 1.0
    assert json.loads(json.dumps(s.as_dict())) == s.as_dict()


@pytest.mark.parametrize("text", ["1", "true", "YES", " on "])
def test_words_for_true(text):
    assert Example(fast=False).replaced({"fast": text}).fast is True


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("sed", "1", ["sed", "seed, min_length, max_length, share, fast, kind"]),
        ("seed", "one", ["seed", "'one'", "int"]),
        ("seed", "-1", ["seed", "-1", "at least 0"]),
        ("seed", str(2**31), ["seed", "at most 2147483647"]),
        ("seed", "1.5", ["seed", "1.5"]),
        ("share", "nan", ["share", "not a number"]),
        ("share", "1.01", ["share", "at most 1"]),
        ("share", "-inf", ["share", "below 0"]),
        ("share", "1,5", ["share", "1,5"]),
        ("fast", "maybe", ["fast", "maybe"]),
        ("kind", "c", ["kind", "'c'", "a, b"]),
    ],
)
def test_refusals_name_the_field_and_the_remedy(key, value, words):
    with pytest.raises(SettingsError) as caught:
        Example().replaced({key: value})
    for word in words:
        assert word in str(caught.value)
    assert caught.value.notice.remedy and caught.value.notice.severity == "error"


def test_path_lengths_in_the_wrong_order():
    with pytest.raises(SettingsError, match=r"Min Path Length \(min_length\): 5 is more than Max Path Length \(max_length\) 2") as caught:
        Example(min_length=5, max_length=2)
    assert caught.value.notice.remedy == "Lower it or raise Max Path Length (max_length)"
    assert Example(min_length=0, max_length=0).max_length == 0


def test_python_values_of_the_wrong_type():
    for bad in ({"seed": True}, {"seed": 1.0}, {"fast": 1}, {"kind": 1}, {"share": "0.5"}):
        with pytest.raises(SettingsError, match="is not of type"):
            Example(**bad)


@pytest.mark.parametrize("solver", registry.methods(), ids=lambda s: s.spec.id)
def test_every_setting_of_every_method_can_be_given_as_text_and_is_bounded(solver):
    defaults = solver.Settings()
    for f in dataclasses.fields(solver.Settings):
        value = getattr(defaults, f.name)
        assert getattr(defaults.replaced({f.name: str(value)}), f.name) == value
        assert f.metadata["label"] and f.metadata["help"]
        if field_type(f) in (int, float):
            assert f.metadata["min"] is not None and f.metadata["max"] is not None, f.name
            with pytest.raises(SettingsError, match=f.name):
                defaults.replaced({f.name: str(f.metadata["max"] * 2 + 1)})


def test_a_budget_may_scale_one_number_of_samples_of_each_random_method():
    names = {m.spec.id: [f.name for f in dataclasses.fields(m.Settings) if f.metadata["effort"]] for m in registry.methods()}
    known = {
        "two_pass": ["samples"],
        "distribution": ["samples"],
        "irradiance_cache": [],
        "path_tracing": ["samples"],
        "particle_tracing": ["particles"],
        "multi_pass": ["samples"],
        "potential": ["samples"],
    }
    assert {id: names[id] for id in known} == known
    assert all(len(found) <= 1 for found in names.values())
    for solver in registry.methods():
        assert all(field_type(f) is int for f in dataclasses.fields(solver.Settings) if f.metadata["effort"])
        assert not names[solver.spec.id] or registry.Nature.NONDETERMINISTIC in solver.spec.natures


def test_a_colour_may_be_given_as_three_numbers_or_as_a_grey():
    @dataclasses.dataclass(frozen=True)
    class Colored(Settings):
        tint: tuple = setting((1.0, 1.0, 1.0), "Tint", "A colour", min=0.0, max=1.0)

    assert Colored(tint=0.5).tint == (0.5, 0.5, 0.5) and Colored(tint=[1, 0, 0.5]).tint == (1.0, 0.0, 0.5)
    assert Colored().replaced({"tint": "1, 0.5,0"}).tint == (1.0, 0.5, 0.0) and Colored().replaced({"tint": "0.2"}).tint == (0.2,) * 3
    for bad in ("red", "1,2", "1,0.5,2", "nan", "0.1,0.2,0.3,0.4", "1_0"):
        with pytest.raises(SettingsError, match="tint"):
            Colored().replaced({"tint": bad})
