"""Images that were read before: kept from one extraction to the next as long as their files are the same.

Pressing Bake extracts the scene that the panel has just checked, and extracts it again when UV layers were made. Of what is read only
images that Blender does not hold are kept: what it holds may be painted or set by a script without any sign. What is computed of pixels
is kept by these pixels and by what it is computed with.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable

import bpy

from ...core.scene.texture import Texture
from ..host.notices import Notices
from ..host.preparation import Aside, once
from .image_header import file_path


class Wanted(Exception):
    """Work on pixels that `work` does without Blender, and that reading cannot go on without. Reading the same again finds it done."""

    def __init__(self, text: str, work: Callable[[], object]) -> None:
        super().__init__(text)
        self._text, self._work = text, work

    def aside(self) -> Aside:
        """The stage that does it."""
        return Aside(self._text, once(self._work))


class Recorder:
    """Passes notices on and keeps those since `begin`, to be said again by who takes what was read."""

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self.said: list[tuple[str, str, str, str]] = []

    def begin(self) -> None:
        """Keep what is said from now on."""
        self.said = []

    def add(self, name: str, reason: str, remedy: str = "", severity: str = "warning") -> None:
        """As `Notices.add`."""
        self.said.append((name, reason, remedy, severity))
        self._notices.add(name, reason, remedy, severity)


class ImageStore:
    """Textures by what they were read from. What one extraction does not ask for is let go at its end."""

    def __init__(self) -> None:
        self._known: dict[tuple, tuple[Texture | None, list[tuple[str, str, str, str]]]] = {}
        self._asked: set[tuple] = set()

    def get(self, key: tuple, notices: Recorder, read: Callable[[], Texture | None]) -> Texture | None:
        """The texture of `key`, by `read` where it is not known; its notices are said either way."""
        self._asked.add(key)
        found = self._known.get(key)
        if found is None:
            notices.begin()
            texture = read()
            self.put(key, texture, notices.said)
            return texture
        for said in found[1]:
            notices.add(*said)
        return found[0]

    def holds(self, key: tuple) -> bool:
        """Whether the texture of `key` is known."""
        return key in self._known

    def put(self, key: tuple, texture: Texture | None, said: list[tuple[str, str, str, str]]) -> None:
        """Keep a texture that was read, and what was said of it, for the next extraction."""
        self._known[key] = texture, list(said)  # not what the recorder goes on with

    def known(self, key: tuple) -> Texture | None:
        """The texture of `key`, which stays known; None where it is not."""
        self._asked.add(key)
        return self._known[key][0] if key in self._known else None

    def drop(self, mark: str) -> None:
        """Forget all whose key begins with `mark`."""
        self._known = {key: found for key, found in self._known.items() if key[0] != mark}

    def settle(self) -> None:
        """The end of an extraction: forget what it did not ask for."""
        self._known = {key: self._known[key] for key in self._asked if key in self._known}
        self._asked = set()

    def clear(self) -> None:
        """Forget everything."""
        self._known, self._asked = {}, set()


KNOWN = ImageStore()


def fingerprint(image: bpy.types.Image) -> tuple | None:
    """All that the pixels of an image that Blender does not hold depend on; None where it holds them or they come from elsewhere."""
    if image.source != "FILE" or image.has_data or image.is_dirty:
        return None
    # Not its file format, for which Blender would decode it.
    how = image.name, image.colorspace_settings.name, image.alpha_mode
    if image.packed_files:
        packed = [item.packed_file.data for item in image.packed_files if item.packed_file is not None]
        return *how, *((len(data), zlib.crc32(data)) for data in packed)
    path = file_path(image)
    try:
        about = os.stat(path)
    except OSError:
        return None
    return *how, path, about.st_mtime_ns, about.st_size, about.st_ino
