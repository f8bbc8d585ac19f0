"""OpenEXR files with 32-bit float channels: the picture as R, G, B, A and any further layers beside it."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR

from ..base.atomic import SOFTWARE, replace_file, require_finite
from ..base.errors import WriteError
from . import exr_numpy as exr_file

# Letters of the channels of a layer with 1, 3 or 4 of them. One letter alone is what Blender calls a value pass.
LETTERS = {1: "V", 3: "RGB", 4: "RGBA"}


def write_exr(
    path: Path,
    image: np.ndarray,
    layers: Mapping[str, np.ndarray] | None = None,
    *,
    folder: Path,
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """Write `image` (h, w, 3 or 4) float32, row 0 at the bottom, and `layers` of (h, w), (h, w, 1), (h, w, 3) or (h, w, 4).

    A layer "direct" becomes the channels direct.R, direct.G, direct.B. Blender shows a file without layers as an image with
    pixels; one with layers is a multilayer image, whose `pixels` Python cannot read there. Values are stored bit for bit.
    `path` must lie in `folder`. Raises TargetError or WriteError; then nothing has changed.
    """
    path = Path(path)
    channels = _channels("", image)
    for name, values in (layers or {}).items():
        if not name or "." in name:
            raise WriteError(str(path), f"{name!r} cannot name a layer", "Use a name without dots")
        channels.update(_channels(name + ".", values))
    shapes = {c.shape for c in channels.values()}
    if len(shapes) != 1:
        raise WriteError(str(path), f"its layers have different sizes {sorted(shapes)}", "Give layers of one size")
    for name, values in channels.items():
        require_finite(f"{path} channel {name}", values)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "software": SOFTWARE}
    header.update({f"adjoint_gi.{key}": str(value) for key, value in (metadata or {}).items()})

    def write(temporary: Path) -> None:
        if not exr_file.wheel_is_safe():
            exr_file.write_file(temporary, channels, {k: v for k, v in header.items() if isinstance(v, str)})
            return
        # Encoded in memory and written by Python: the library takes no path that is not UTF-8 and hides why a write failed.
        encoded = io.BytesIO()
        OpenEXR.File(header, {k: v.copy() for k, v in channels.items()}).write(encoded)
        with open(temporary, "wb") as file:
            file.write(encoded.getbuffer())

    def verify(temporary: Path) -> bool:
        back = _read(temporary)[0]
        return set(back) == set(channels) and all(np.array_equal(back[k].view(np.uint32), v.view(np.uint32)) for k, v in channels.items())

    return replace_file(path, folder, write=write, verify=verify, ours=is_ours)


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Layers by name ("" is the picture) as (h, w, c) float32, row 0 at the bottom, and our metadata. Raises WriteError if unreadable."""
    try:
        channels, header = _read(Path(path))
    except (RuntimeError, OSError) as error:
        raise WriteError(str(path), f"cannot be read as OpenEXR ({error})", "Bake it again") from error
    layers: dict[str, dict[str, np.ndarray]] = {}
    for name, values in channels.items():
        layer, _, letter = name.rpartition(".")
        layers.setdefault(layer, {})[letter] = values
    out = {}
    for layer, parts in layers.items():
        letters = next((text for text in LETTERS.values() if set(text) == set(parts)), "".join(sorted(parts)))
        out[layer] = np.ascontiguousarray(np.stack([parts[x] for x in letters], axis=-1)[::-1])
    return out, {k.removeprefix("adjoint_gi."): v for k, v in header.items() if k.startswith("adjoint_gi.")}


def is_ours(path: Path) -> bool:
    """Whether this is an OpenEXR file that Adjoint GI wrote."""
    try:
        if not exr_file.wheel_is_safe():
            return exr_file.read_strings(path).get("software") == SOFTWARE
        with open(path, "rb") as stream, OpenEXR.File(stream, header_only=True) as file:
            return file.header().get("software") == SOFTWARE
    except (RuntimeError, OSError, ValueError):
        return False


def _channels(prefix: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """One (h, w) float32 array for each channel, with the top row first as OpenEXR stores it."""
    values = np.asarray(values, np.float32)
    if values.ndim == 2:
        values = values[..., None]
    if values.ndim != 3 or values.shape[2] not in LETTERS or 0 in values.shape:
        raise WriteError(prefix.rstrip(".") or "image", f"has the shape {values.shape}", "Give (h, w) or (h, w, 1, 3 or 4) values")
    if prefix == "" and values.shape[2] == 1:
        values = np.repeat(values, 3, axis=2)
    return {prefix + letter: np.ascontiguousarray(values[::-1, :, k]) for k, letter in enumerate(LETTERS[values.shape[2]])}


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    if not exr_file.wheel_is_safe():
        return exr_file.read_file(path)
    with open(path, "rb") as stream, OpenEXR.File(stream, separate_channels=True) as file:
        return {name: np.array(c.pixels) for name, c in file.channels().items()}, dict(file.header())
