# SPDX-License-Identifier: GPL-3.0-or-later
"""The built zip in a Blender that has never seen it: install, use, disable."""

from __future__ import annotations

import json

import pytest


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("baked")


@pytest.fixture(scope="module")
def seen(in_blender, own_zip, folder):
    """What lifecycle.py saw; that it ended by itself with exit code 0 is checked on the way."""
    printed = in_blender("lifecycle.py", own_zip, folder)
    (line,) = [line for line in printed.splitlines() if line.startswith("SEEN ")]
    return json.loads(line.removeprefix("SEEN "))


def test_installs_and_enables(seen):
    assert seen["enabled"]
    kinds = seen["registered"]
    assert kinds["classes"] and kinds["operators"] and kinds["commands"] == ["adjoint_gi"]
    assert "Scene.adjoint_gi" in kinds["properties"]


def test_wheels_are_unpacked(seen):
    assert any(name.startswith("embreex-") for name in seen["wheels"])
    assert any(name.startswith("openexr-") for name in seen["wheels"])
    assert not any(name.startswith("numpy") for name in seen["wheels"])


def test_bakes(seen, folder):
    assert seen["bake"] == 0
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert report
    assert list(folder.glob("**/*.exr"))


def test_breaks_no_policy(seen):
    assert seen["warnings"] == {}


def test_disabling_leaves_nothing(seen):
    assert seen["left"] == {}


def test_twenty_times_leaves_nothing(seen):
    assert seen["left_after_twenty"] == {}
