"""`tdof-npid`: one program; each subcommand is a module of its own, imported only when it is called."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import sys
import warnings
from collections.abc import Sequence

from tdof_npid_ros import TYPE_CHECKING, __version__
from tdof_npid_ros.graph import NEEDS_ROS, ros_is_missing
from tdof_npid_ros.names import meant_hint
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.streams import prepare_streams

if TYPE_CHECKING:
    from typing import NoReturn

# Name, and its one line of help. The module is cli.<name>: add_arguments(parser) and run(arguments) -> exit status.
SUBCOMMANDS = {
    "run": "all the loop's nodes in one command: play a case's episodes over ROS 2",
    "live": "see and steer a loop in the browser",
    "set": "set parameters or the setpoint of a running loop",
    "get": "parameters and diagnostics of a running loop",
    "reset": "let a running loop's plant begin once more",
    "commission": "from a running loop to gains: experiment, identify, tune, apply, confirm",
    "experiment": "a step, doublet or relay on a running loop, under its controller's guard",
    "new": "write a commented parameter file for a plant of your own",
    "check": "look at a parameter file as an experienced colleague would",
    "demo": "run the paper's first process over ROS 2, end to end",
    "simulate": "run a case in process and print its metrics",
    "margins": "how far a loop is from instability: M_s, gain, phase and delay margin, slowest mode",
    "certify": "whether a loop is proved to come to rest from every state, and what is not claimed",
    "tune": "find the gains of a case with the hybrid genetic algorithm",
    "robust": "how gains do on thousands of plants near the model",
    "pareto": "the trade-off between tracking and rejection, of a case or of the paper's Figure 6",
    "reproduce": "every table and figure of the paper, published beside ours",
    "identify": "a plant's model from a recording, with what the recording cannot tell",
    "analyze": "metrics and pictures of the episodes in bags",
    "verify": "recompute every control effort of a bag and compare bit for bit",
    "recover": "rewrite a damaged or unfinished bag whole",
    "replay": "publish a bag again over ROS 2",
    "bench": "measure the claims about speed on this machine",
}
USAGE_ERROR = 2
LONGEST_ERROR = 2000  # characters
INTERRUPTED = 130  # as a shell gives it after Ctrl-C
COMPLETING = "_ARGCOMPLETE"  # environment variable: a shell asks how a line may go on
READER_GONE = 141  # as a shell gives it when the reader of a pipe has gone


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong with the arguments."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE_ERROR, f"{self.prog}: {one_line(message)}: see {self.prog} --help\n")

    def refuse(self, arguments: Sequence[str]) -> NoReturn:
        """Say that these are no arguments here, and which option is meant."""
        hints = [meant_hint(one.partition("=")[0], self._option_string_actions) for one in arguments if one[:1] == "-"]
        self.error(f"unrecognized arguments: {' '.join(arguments)}{next(filter(None, hints), '')}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit status: 0 only on success, 2 for bad input."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if COMPLETING in os.environ and arguments is None:
        given = os.environ.get("COMP_LINE", "").split()[1:]
    name = given[0] if given and given[0] in SUBCOMMANDS else ""
    try:
        status = _run(given, name)
        sys.stdout.flush()
        if (failure := getattr(sys.stdout, "failure", None)) is not None:  # after all that was to be done
            raise failure
        return status
    except BrokenPipeError:  # before OSError, which it is: whoever reads our output has had enough
        return READER_GONE
    except (ValueError, OSError, RuntimeError, MemoryError, ArithmeticError) as error:
        print(f"tdof-npid {name}: {_message(error)}", file=sys.stderr)
        return USAGE_ERROR
    except ModuleNotFoundError as error:
        if not ros_is_missing(error):
            raise
        print(f"tdof-npid {name}: {NEEDS_ROS}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print(f"tdof-npid {name}: interrupted", file=sys.stderr)
        return INTERRUPTED


def _run(given: list[str], chosen: str) -> int:
    parser = _Parser(prog="tdof-npid", description="Nonlinear two-degree-of-freedom PID control loops.")
    parser.add_argument("--version", action="version", version=f"tdof-npid {__version__}")
    completing = COMPLETING in os.environ
    if given and not chosen and not given[0].startswith("-") and not completing:
        parser.error(f"there is no subcommand {given[0]!r}{meant_hint(given[0], SUBCOMMANDS)}")
    parser_of_chosen = parser
    subparsers = parser.add_subparsers(dest="subcommand", metavar="SUBCOMMAND", required=True)
    for name, text in SUBCOMMANDS.items():
        subparser = subparsers.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        subparser.add_argument("--json", action="store_true", help="print one JSON object, for scripts")
        if name == chosen:
            parser_of_chosen = subparser
            importlib.import_module(f"{__name__}.{name}").add_arguments(subparser)
    if completing:
        _complete(parser)
    parsed, strange = parser.parse_known_args(given)
    if strange:
        parser_of_chosen.refuse(strange)
    return int(importlib.import_module(f"{__name__}.{parsed.subcommand}").run(parsed))


def _complete(parser: argparse.ArgumentParser) -> None:
    """Tell the shell how the line may go on, and end, where `argcomplete` is installed and the shell has asked."""
    with contextlib.suppress(ModuleNotFoundError):
        importlib.import_module("argcomplete").autocomplete(parser)


def _message(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return one_line(f"{error.filename}: {error.strerror}")
    return one_line(error, LONGEST_ERROR)


def entry() -> None:
    """The console script."""
    prepare_streams()
    warnings.formatwarning = lambda message, *_, **__: f"tdof-npid: {message}\n"  # in one line, as errors are
    sys.exit(main())
