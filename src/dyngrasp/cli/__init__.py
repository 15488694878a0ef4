"""The command line: `dyngrasp run | plan | study | perceive | calibrate | bench | models | check`."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from dyngrasp.cli.arguments import BAD_INPUT, DELIVERED, INTERRUPTED, argument_parser

# A command is looked up here and imported when it is called, so that `--help` does not wait for the solvers.
COMMANDS = {
    "run": ("dyngrasp.cli.run", "run"),
    "plan": ("dyngrasp.cli.run", "plan"),
    "study": ("dyngrasp.cli.study", "study"),
    "perceive": ("dyngrasp.cli.perceive", "perceive_folder"),
    "calibrate": ("dyngrasp.cli.calibrate", "calibrate"),
    "bench": ("dyngrasp.cli.bench", "bench"),
    "models": ("dyngrasp.cli.inspect", "models"),
    "check": ("dyngrasp.cli.inspect", "check"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: What follows `dyngrasp` on the command line; None takes it from there.

    Returns:
        The exit status: 0 done and good, 1 done and not good, 2 bad input, 130 interrupted.
    """
    options = argument_parser(_version()).parse_args(arguments)
    _quiet_threads()
    module, function = COMMANDS[options.command]
    try:
        return _guarded(getattr(import_module(module), function), options)
    except KeyboardInterrupt:
        print("dyngrasp: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of a pipe left, as `head` does. What Python still has buffered would fail once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DELIVERED


def _guarded(command: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    from dyngrasp.errors import DyngraspError

    try:
        return command(options)
    except DyngraspError as error:
        print(f"dyngrasp: error: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT


def _version() -> str:
    from dyngrasp import __version__

    return __version__


def _quiet_threads() -> None:
    """One thread of linear algebra a process: matrices of seven joints gain nothing from more."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
