# SPDX-License-Identifier: GPL-3.0-or-later
"""The arguments of the command line, the bake they ask for, and the exit codes."""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
from typing import NoReturn

from ...core.base.errors import SettingsError
from ...core.base.settings import Settings, field_type
from ...core.base.text import printable
from ...core.method import registry
from ...core.method.solution import QUANTITIES
from ..comparison import arguments as compare_arguments
from ..comparison.arguments import whole
from ..host import files
from ..props.request import DEFAULT_METHOD, DOMAINS, RECEIVERS, BakeRequest, denoises_by_default

DEFAULTS = {f.name: f.default for f in dataclasses.fields(BakeRequest) if f.default is not dataclasses.MISSING}
MOST_THREADS = 256
DONE, FAILED, REFUSED, INTERRUPTED = 0, 1, 2, 130
# One method for each quadrant of the taxonomy: gathering or shooting, deterministic or not.
DEMO_METHODS = ("path_tracing", "particle_tracing", "matrix_radiosity", "progressive_radiosity")


class Parser(argparse.ArgumentParser):
    """Its errors quote arguments, which are one line each whatever they hold."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong with the arguments, and exit."""
        super().error(printable(message))


def make_parser(in_blender: bool) -> Parser:
    """The one parser of both entries; inside Blender the open file is used when no scene is named."""
    program = "blender -b scene.blend --command adjoint_gi" if in_blender else "adjoint-gi"
    parser = Parser(prog=program, description="Bake global illumination by gathering and shooting methods.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    bake = commands.add_parser("bake", help="bake a scene to textures, colour attributes or a picture", epilog=settings_help())
    bake.formatter_class = argparse.RawDescriptionHelpFormatter
    add_request(bake, in_blender)
    bake.add_argument("--report", metavar="FILE", help="write a JSON report")
    bake.add_argument("--save-blend", metavar="FILE", help="save the scene with the result in it as this file")
    bake.add_argument("--overwrite", action="store_true", help="let --save-blend replace an existing file")
    check = commands.add_parser("check", help="report what would prevent a bake, without baking")
    add_request(check, in_blender)
    listing = commands.add_parser("methods", help="list the methods")
    listing.add_argument("--json", action="store_true", help="as JSON")
    compare = commands.add_parser("compare", help="compare methods within one budget, as a page with tables and pictures")
    compare_arguments.add_arguments(compare, in_blender)
    demo = commands.add_parser("demo", help="build a Cornell box and bake it by a method of each kind, to every target")
    demo.add_argument("--output", default="adjoint-gi-demo", metavar="DIR", help="folder for the pictures (default: %(default)s)")
    demo.add_argument(
        "--methods",
        nargs="+",
        default=list(DEMO_METHODS),
        metavar="ID",
        help="methods that make a picture, or all (default: %(default)s)",
    )
    demo.add_argument("--size", type=whole, default=480, help="width and height of the pictures (default: %(default)s)")
    demo.add_argument("--threads", type=whole, metavar="N", help=f"threads, 1 to {MOST_THREADS} (default: one for each core)")
    return parser


def add_request(parser: argparse.ArgumentParser, in_blender: bool) -> None:
    """Arguments that describe a bake."""
    default = "default: %(default)s"
    compare_arguments.add_scene(parser, in_blender)
    parser.add_argument("--method", default=DEFAULT_METHOD, help=f"see the command `methods` ({default})")
    parser.add_argument("--target", default="texture", choices=tuple(RECEIVERS), help=default)
    parser.add_argument("--quantity", default=DEFAULTS["quantity"], choices=QUANTITIES, help=default)
    parser.add_argument("--objects", nargs="+", action="extend", default=[], metavar="NAME", help="mesh objects (default: all rendered)")
    parser.add_argument("--resolution", type=whole, default=DEFAULTS["resolution"], help=f"width and height in texels ({default})")
    parser.add_argument("--atlas", action="store_true", help="one lightmap for all objects")
    parser.add_argument("--uv-layer", default="", metavar="NAME", help="UV layer to bake into (default: one made for the lightmap)")
    what = "texels a metre of lightmaps, and no more, as far as the resolution has room (default: fill the image)"
    parser.add_argument("--texels-per-metre", type=float, default=DEFAULTS["texels_per_metre"], metavar="N", help=what)
    parser.add_argument("--renew-uvs", action="store_true", help="make the lightmap UVs anew even where they fit")
    parser.add_argument("--margin", type=whole, default=DEFAULTS["margin"], help=f"texels by which charts are extended ({default})")
    parser.add_argument("--subsamples", type=whole, default=DEFAULTS["subsamples"], help=f"points in each texel ({default})")
    parser.add_argument("--attribute", default=DEFAULTS["attribute"], metavar="NAME", help=f"name of the colour attribute ({default})")
    parser.add_argument("--domain", default=DEFAULTS["domain"], choices=DOMAINS, help=default)
    what = "write the attribute to a new object: the elements of element methods, or the evaluated mesh"
    parser.add_argument("--new-object", action="store_true", help=what)
    what = "bake instances too, each as an object of its own; objects named then mean what they make as well"
    parser.add_argument("--instances", action="store_true", help=what)
    what = "take noise out of what is written, of methods that have any (default: lightmaps and attributes by path tracing)"
    parser.add_argument("--denoise", action=argparse.BooleanOptionalAction, default=None, help=what)
    parser.add_argument("--size", metavar="WxH", help="size of the picture (default: that of the render settings)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the method; may be repeated")
    parser.add_argument("--seed", type=whole, help="start of the random numbers")
    parser.add_argument("--threads", type=whole, metavar="N", help=f"threads, 1 to {MOST_THREADS} (default: one for each core)")
    parser.add_argument("--output", default="", metavar="DIR", help="folder for EXR and PNG files")


def settings_help() -> str:
    """Every setting of every method with its default, for --help."""
    lines = ["settings for --set, common to all methods:"]
    common = {f.name for f in dataclasses.fields(Settings)}
    lines += [_setting(f) for f in dataclasses.fields(Settings)]
    for solver in registry.methods():
        own = [f for f in dataclasses.fields(solver.Settings) if f.name not in common]
        lines += [f"{solver.spec.id}:", *(_setting(f) for f in own)]
    return "\n".join(lines)


def _setting(f: dataclasses.Field) -> str:
    color = field_type(f) is tuple
    choices = "|".join(c[0] for c in f.metadata["choices"]) or ("R,G,B" if color else field_type(f).__name__)
    default = ",".join(f"{x:g}" for x in f.default) if color else f.default
    return f"  {f.name}={default}  ({choices}) {f.metadata['help']}"


def request_of(options: argparse.Namespace) -> BakeRequest:
    """The bake that `options` ask for; raises `SettingsError` for a wrong method, setting or size."""
    solver = registry.method(options.method)
    values: dict[str, str] = {}
    for text in options.set:
        key, equals, value = text.partition("=")
        if not equals:
            raise SettingsError(f"--set {text}", "is not of the form KEY=VALUE", "Write, for example, --set seed=1")
        values[key.strip()] = value.strip()
    if options.seed is not None:
        values["seed"] = str(options.seed)
    width, height = _size(options.size)
    return BakeRequest(
        method=options.method,
        settings=solver.Settings().replaced(values),
        target=options.target,
        objects=tuple(dict.fromkeys(options.objects)),
        quantity=options.quantity,
        resolution=options.resolution,
        atlas=options.atlas,
        uv_layer=options.uv_layer,
        texels_per_metre=options.texels_per_metre,
        renew_uvs=options.renew_uvs,
        margin=options.margin,
        subsamples=options.subsamples,
        attribute=options.attribute,
        domain=options.domain,
        new_object=options.new_object,
        instances=options.instances,
        output=str(files.absolute(options.output)) if options.output and not options.output.startswith("//") else options.output,
        width=width,
        height=height,
        denoise=denoises_by_default(options.method, options.target) if options.denoise is None else options.denoise,
    )


def use_threads(wanted: int | None) -> None:
    """Let the core use `wanted` threads; raises `SettingsError` outside of 1 to 256."""
    if wanted is None:
        return
    if not 1 <= wanted <= MOST_THREADS:
        raise SettingsError("--threads", f"{wanted} is not possible", f"Give 1 to {MOST_THREADS}")
    os.environ["ADJOINT_GI_THREADS"] = str(wanted)


def _size(text: str | None) -> tuple[int, int]:
    if text is None:
        return 0, 0
    found = re.fullmatch(r"([0-9]{1,9})[xX]([0-9]{1,9})", text)
    width, height = map(int, found.groups()) if found else (0, 0)
    if not (width and height):
        raise SettingsError(f"--size {text}", "is not of the form WIDTHxHEIGHT", "Write, for example, --size 480x270")
    return width, height
