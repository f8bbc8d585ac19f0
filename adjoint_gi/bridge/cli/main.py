# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line, in two ways with the same arguments:

    blender -b scene.blend --command adjoint_gi bake --method path_tracing --output DIR
    adjoint-gi bake scene.blend --method path_tracing --output DIR          (console command on the bpy wheel)

Exit codes: 0 everything asked for was written and read back, 1 failed, 2 refused input, 130 interrupted (the partial result is written).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import NoReturn

import bpy

from .... import solvers
from ...core.base.errors import AdjointError, Notice, WriteError
from ...core.method.driver import INTERRUPTS, answering
from ..props import properties
from . import bake as cli_bake
from . import compare as cli_compare
from . import demo as cli_demo
from . import methods as cli_methods
from . import open as cli_open
from .arguments import DONE, FAILED, INTERRUPTED, REFUSED, make_parser
from .streams import guarded, say, say_notices, say_traceback

COMMANDS = {
    "bake": cli_bake.bake,
    "check": cli_bake.check,
    "methods": cli_methods.methods,
    "demo": cli_demo.demo,
    "compare": cli_compare.compare,
}

_handle = None


def main(arguments: Sequence[str], in_blender: bool) -> int:
    """Carry out one command; returns the exit code. `in_blender`: a file is open already, and none has to be named."""
    solvers.load()
    with guarded() as (out, _), answering(_interrupt, INTERRUPTS[1:]):
        code = _carry_out(arguments, in_blender)
        out.flush()
        if out.lost:
            say_notices([Notice("Standard output", f"could not be written ({out.lost})", "Send it elsewhere", "error")])
            # The answer of these is what they print; other commands have written files.
            if code == DONE and arguments[0] in ("check", "methods"):
                code = FAILED
    return code


def _interrupt(*_: object) -> NoReturn:
    """A signal that ends programs is an interruption as Ctrl-C is one; while a method solves, the driver listens."""
    raise KeyboardInterrupt


def _carry_out(arguments: Sequence[str], in_blender: bool) -> int:
    try:
        options = make_parser(in_blender).parse_args(list(arguments))
        options.in_blender = in_blender
        return COMMANDS[options.command](options)
    except SystemExit as error:  # argparse has printed its message
        return error.code if isinstance(error.code, int) else REFUSED
    except KeyboardInterrupt:
        say("interrupted before a result was written", error=True)
        return INTERRUPTED
    except WriteError as error:
        say_notices([error.notice])
        return FAILED
    except AdjointError as error:
        say_notices([error.notice, *error.others])
        return REFUSED
    except Exception:
        say_traceback()
        return FAILED


def console() -> None:
    """Entry point of `adjoint-gi`, where no extension is enabled that would know what a file holds of ours: densities and a result.

    Ends the process at once, for an interpreter with Blender inside may hang while it is taken apart.
    """
    properties.register()
    os._exit(main(sys.argv[1:], in_blender=False))


def _command(arguments: list[str]) -> int:
    """What follows `--command adjoint_gi`."""
    return main(arguments, in_blender=True)


def register() -> None:
    """Add the command to Blender."""
    global _handle
    cli_open.register()
    _handle = bpy.utils.register_cli_command("adjoint_gi", _command)


def unregister() -> None:
    """Take it back."""
    global _handle
    cli_open.unregister()
    if _handle is not None:
        bpy.utils.unregister_cli_command(_handle)
        _handle = None
