# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line, in two ways with the same arguments:

    blender -b scene.blend --command adjoint_gi bake --method path_tracing --output DIR
    adjoint-gi bake scene.blend --method path_tracing --output DIR          (console command on the bpy wheel)

Exit codes: 0 everything asked for was written and read back, 1 failed, 2 refused input, 130 interrupted (the partial result is written).
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence

import bpy

from .... import solvers
from ...core.base.errors import AdjointError, WriteError
from . import bake as cli_bake
from . import compare as cli_compare
from . import demo as cli_demo
from . import methods as cli_methods
from . import open as cli_open
from .arguments import FAILED, INTERRUPTED, REFUSED, make_parser
from .progress import say_notices

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
    try:
        options = make_parser(in_blender).parse_args(list(arguments))
        options.in_blender = in_blender
        return COMMANDS[options.command](options)
    except SystemExit as error:  # argparse has printed its message
        return error.code if isinstance(error.code, int) else REFUSED
    except KeyboardInterrupt:
        print("interrupted before a result was written", file=sys.stderr)
        return INTERRUPTED
    except WriteError as error:
        say_notices([error.notice])
        return FAILED
    except AdjointError as error:
        say_notices([error.notice, *error.others])
        return REFUSED
    except Exception:
        traceback.print_exc()
        return FAILED


def console() -> None:
    """Entry point of `adjoint-gi`; ends the process at once, for an interpreter with Blender inside may hang while it is taken apart."""
    code = main(sys.argv[1:], in_blender=False)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _command(arguments: list[str]) -> int:
    """What follows `--command adjoint_gi`."""
    code = main(arguments, in_blender=True)
    sys.stdout.flush()
    sys.stderr.flush()
    return code


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
