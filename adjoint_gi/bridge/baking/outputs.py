# SPDX-License-Identifier: GPL-3.0-or-later
"""What the files of a bake are called, and whether files that are not ours have these names."""

from __future__ import annotations

from ...core.base.atomic import check_target
from ...core.base.errors import AdjointError, Notice
from ...core.images import exr, png
from ...core.scene.arrays import SceneArrays
from ..host import files
from ..props.request import BakeRequest

COMPONENTS = " components"  # what the name of a lightmap with all its parts ends in


def title(request: BakeRequest, scene: str, source: str) -> str:
    """What is in one image: the `scene`, or the object `source`."""
    if request.target == "render":
        return scene
    return f"{scene} atlas" if request.atlas else source


def stem(request: BakeRequest, title: str, partial: bool = False) -> str:
    """Name of the files of one image, without endings."""
    what = request.method if request.target == "render" else request.quantity
    return f"{title} {what}{' partial' if partial else ''}"


def problems(request: BakeRequest, arrays: SceneArrays, receiving: list[int], scene: str) -> list[Notice]:
    """Errors for files that could not be replaced at the end of the bake; `receiving` are indices of objects, as in preflight."""
    if not request.output or request.target == "attribute":
        return []
    folder = files.output_folder(request.output, create=False)
    sources = [arrays.objects[i].source for i in receiving] if request.target == "texture" else [scene]
    found = []
    for name in dict.fromkeys(stem(request, title(request, scene, source)) for source in sources):
        places = [(name, ".exr", exr.is_ours), (name, ".png", png.is_ours)]
        if request.target == "texture":
            places.append((name + COMPONENTS, ".exr", exr.is_ours))
        for words, suffix, ours in places:
            try:
                check_target(files.output_file(folder, words, suffix), folder, ours)
            except AdjointError as error:
                found.append(error.notice)
    return found
