# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of every format that Blender saves, damaged at random, through Blender's image loading wherever we let them:

    python tests/damaged_images.py FOLDER [SEED] [COUNT]        (a Python that has the bpy wheel, or --python of a Blender, after --)

Each is opened as `bridge.extract.images` opens one, unless `core.images.headers` refuses it. What crashes Blender ends this process, and is
the file `bad` in FOLDER then. At the end a line says how many were refused, had pixels, and had none.
"""

from __future__ import annotations

import importlib.util
import os
import random
import struct
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "CINEON", "DPX", "IRIS", "JPEG2000", "HDR", "TARGA", "TARGA_RAW", "TIFF")
SAVED_SINCE_5 = ("CINEON", "DPX", "IRIS")  # Blender 4.2 and 4.3 crash when they save these, or cannot read their own
SIDE = 40
LARGEST = 1 << 26  # bytes of a picture that is opened: this is about crashes, not about memory


def pictures(folder: Path) -> list[Path]:
    """One file of each format, and one of each compression of OpenEXR."""
    import bpy
    import numpy as np

    pixels = np.ones((SIDE, SIDE, 4), np.float32)
    pixels[..., :3] = np.linspace(0, 1, SIDE)[:, None, None] + np.random.default_rng(0).random((SIDE, SIDE, 3)) * 0.1
    image = bpy.data.images.new("made", SIDE, SIDE, alpha=True, float_buffer=True)
    image.pixels.foreach_set(pixels.ravel())
    scene = bpy.context.scene
    settings = scene.render.image_settings
    made = []
    for kind in FORMATS:
        if kind not in SAVED_SINCE_5 or bpy.app.version >= (5, 0):
            settings.file_format = kind
            made.append(folder / f"whole.{kind.lower()}")
            image.save_render(str(made[-1]), scene=scene)
    settings.file_format = "OPEN_EXR"
    for codec in ("NONE", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "DWAA"):
        for depth in ("16", "32"):
            settings.exr_codec, settings.color_depth = codec, depth
            made.append(folder / f"whole.{codec}{depth}.exr")
            image.save_render(str(made[-1]), scene=scene)
    bpy.data.images.remove(image)
    return made


def damaged(data: bytes, rng: random.Random) -> bytes:
    """`data` cut off, or with bytes, fields or stretches changed, removed or put in."""
    out = bytearray(data)
    where, early = rng.randrange(len(out)), rng.randrange(min(len(out), rng.choice((64, 400, 2000))))
    kind = rng.randrange(6)
    if kind == 0:
        return data[:where]
    if kind == 1:
        for _ in range(rng.choice((1, 2, 8, 30))):
            out[rng.randrange(len(out))] = rng.randrange(256)
    elif kind == 2:
        out[early] = rng.randrange(256)
    elif kind == 3:
        length = rng.choice((4, 16, 100, 1000))
        out[where : where + length] = rng.choice((b"\0", b"\xff")) * length
    elif kind == 4:
        field = rng.choice((0, 1, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, len(out), len(out) - 1))
        out[early : early + 4] = struct.pack(rng.choice("<>") + "I", field)
    else:
        out[where : rng.choice((where, where + 1, where + 50))] = bytes(rng.randrange(256) for _ in range(rng.choice((0, 1, 4, 50))))
    return bytes(out)


def main(folder: Path, seed: int = 1, count: int = 60) -> None:
    """Open `count` damaged files of each picture."""
    import bpy
    import numpy as np
    from adjgi.adjoint_gi.core.images.headers import header_of_bytes

    told = {"refused": 0, "read": 0, "empty": 0}
    for whole in pictures(folder):
        data, rng = whole.read_bytes(), random.Random(f"{seed} {whole.name}")
        header = header_of_bytes(data)
        assert (header.width, header.height, header.danger) == (SIDE, SIDE, ""), whole
        for _ in range(count):
            bad = damaged(data, rng)
            header = header_of_bytes(bad)
            if header is None or header.danger or header.bytes > LARGEST:
                told["refused"] += 1
                continue
            path = folder / f"bad{whole.suffix}"
            path.write_bytes(bad)
            image = bpy.data.images.load(str(path))
            size = image.size[0] * image.size[1] * image.channels
            if size:
                image.pixels.foreach_get(np.empty(size, np.float32))
            told["read" if size else "empty"] += 1
            bpy.data.images.remove(image)
            path.unlink()
    print(told, flush=True)


if __name__ == "__main__":
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT / "tests"]
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
    main(Path(words[0]), *map(int, words[1:]))
    os._exit(0)  # an interpreter with Blender inside may crash while it is taken apart
