"""Atlases rest before they are taken apart: xatlas waits for ever for a thread that is about to fall asleep."""

from __future__ import annotations

import time
import weakref

import pytest
from adjgi.adjoint_gi.core.receivers import atlas as own


class Atlas:
    """Stands in for xatlas's."""

    def generate(self, charts, packing) -> None:
        self.made = True


@pytest.fixture
def quick(monkeypatch):
    """Rests that end soon, and none from before."""
    monkeypatch.setattr(own, "REST", 0.05)
    end = time.monotonic() + 10
    while own._watched and time.monotonic() < end:
        time.sleep(0.02)


def test_an_atlas_outlives_many_others_and_all_go_in_the_end(quick):
    made = []
    for _ in range(own.MOST + 20):
        atlas = Atlas()
        own.generate(atlas, None)
        assert atlas.made
        made.append(weakref.ref(atlas))
        del atlas
        assert all(ref() is not None for ref in made[-own.MOST :])
    assert len(own._kept) == own.MOST and all(ref() is None for ref in made[:20])
    end = time.monotonic() + 10
    while own._watched and time.monotonic() < end:
        time.sleep(0.02)
    assert not own._kept and all(ref() is None for ref in made)
