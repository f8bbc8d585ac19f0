# SPDX-License-Identifier: GPL-3.0-or-later
"""The arguments of the command `compare`, and the comparison they ask for."""

from __future__ import annotations

import argparse
import dataclasses
import re
from collections.abc import Sequence

from ...core.base.errors import SettingsError
from ...core.base.settings import Settings
from ...core.comparison.budget import Budget
from ...core.method import registry
from ..host import files
from .request import PLACES, CompareRequest, ReferenceChoice


def whole(text: str) -> int:
    """A whole number of at most 18 digits of ASCII; `int` alone also reads 1_0, digits of other scripts, and numbers that numpy cannot
    hold. Raises argparse's error."""
    if not re.fullmatch(r"[+-]?[0-9]{1,18}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number")
    return int(text)


def add_scene(parser: argparse.ArgumentParser, in_blender: bool) -> None:
    """The scene that a command works on; inside Blender the open file is used when none is named."""
    if in_blender:
        parser.add_argument("scene", nargs="?", help="a .blend file instead of the open one")
    else:
        parser.add_argument("scene", help="the .blend file")


def add_arguments(parser: argparse.ArgumentParser, in_blender: bool) -> None:
    """Arguments of `compare`."""
    default = "default: %(default)s"
    add_scene(parser, in_blender)
    parser.add_argument("--methods", default="all", metavar="A,B,C", help=f"methods separated by commas, or all that fit ({default})")
    parser.add_argument("--budget", default="time=10", metavar="KIND=VALUE", help=f"for each: time=S, rays=N or error=RMSE ({default})")
    parser.add_argument(
        "--limit", type=float, default=300.0, metavar="S", help=f"most seconds of a method, whatever the budget ({default})"
    )
    parser.add_argument(
        "--reference",
        default="path_tracing",
        metavar="WHAT",
        help=f"METHOD[:SECONDS], cycles[:SAMPLES], constant=V, constant=R,G,B or none ({default}, for four times the budget)",
    )
    parser.add_argument("--receivers", default="texture", choices=PLACES, help=f"texels of the objects, or pixels ({default})")
    parser.add_argument("--objects", nargs="+", action="extend", default=[], metavar="NAME", help="mesh objects (default: all rendered)")
    parser.add_argument("--resolution", type=whole, default=32, help=f"texels a side, or pixels of the longer side ({default})")
    parser.add_argument("--set", action="append", default=[], metavar="METHOD.KEY=VALUE", help="a setting of a method; may be repeated")
    parser.add_argument(
        "--repeats", type=whole, default=4, help=f"runs with other seeds, which measure the noise of random methods ({default})"
    )
    parser.add_argument("--seed", type=whole, default=0, help=f"start of the random numbers ({default})")
    parser.add_argument("--threads", type=whole, metavar="N", help="threads, 1 to 256 (default: one for each core)")
    parser.add_argument("--output", required=True, metavar="DIR", help="folder for index.html, compare.json and the pictures")


def request_of(options: argparse.Namespace) -> CompareRequest:
    """What `options` ask for; raises SettingsError."""
    methods = () if options.methods.strip() == "all" else tuple(m.strip() for m in options.methods.split(",") if m.strip())
    if options.methods.strip() != "all" and not methods:
        raise SettingsError("--methods", "names none", "Give methods separated by commas, or all")
    return CompareRequest(
        methods,
        Budget.parse(options.budget, options.limit),
        ReferenceChoice.parse(options.reference),
        options.receivers,
        tuple(dict.fromkeys(options.objects)),
        options.resolution,
        settings_of(options.set, options.seed),
        options.repeats,
        options.seed,
        str(files.absolute(options.output)),
    )


def settings_of(texts: Sequence[str], seed: int) -> dict[str, Settings]:
    """Settings of the methods that METHOD.KEY=VALUE texts name."""
    values: dict[str, dict[str, str]] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        method, dot, key = name.strip().partition(".")
        if not (equals and dot):
            raise SettingsError(f"--set {text}", "is not of the form METHOD.KEY=VALUE", "Write, for example, --set whitted.depth=4")
        values.setdefault(method, {})[key] = value.strip()
    return {m: dataclasses.replace(registry.method(m).Settings(), seed=seed).replaced(v) for m, v in values.items()}
