"""The command ``rl2grid``.

Each subcommand has a module, which adds its flags to a parser, calls one function of the layer below and says the
result. What a user did wrong is said in one sentence, without a traceback, with exit status 2.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import sys
import warnings
from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import Any, NoReturn

from rl2grid import __version__
from rl2grid.cli.complaints import in_words
from rl2grid.cli.output import Output
from rl2grid.errors import DamageWarning, UsageError
from rl2grid.records.files import printable

REFUSED = 2
INTERRUPTED = 130
"""Exit status after an interrupt, as shells have it."""

COMMANDS: dict[str, str] = {
    "demo": "train DQN on bus14, evaluate it beside simple agents, write a report",
    "tasks": "list the tasks (103 of the paper and 96 joint ones) and their sizes",
    "train": "train an algorithm on a task",
    "pretrained": "list the policies that come with the package, and how each was made",
    "teach": "label training months with what an agent decides, for another one to learn from",
    "evaluate": "play agents on enumerated scenarios, one row per episode",
    "rank": "rank a grid's topology actions by trying them",
    "analyse": "tables and figures from evaluations and training runs",
    "report": "one HTML page with all results, figures, episodes and commands",
    "leaderboard": "entries that anyone can play again, and their ranking",
    "actions": "list, explain and draw a grid's topology actions",
    "data": "list, make, import, export, check, clean and download scenarios",
    "watch": "play one episode and make it visible: a page, an animation",
    "study": "run, follow and tune many trainings and evaluations from one file",
    "completion": "print a script that lets a shell complete commands and flags",
}
"""What each command does; its flags and all else are in ``rl2grid.cli.<command>``, imported when it is chosen."""


class Parser(argparse.ArgumentParser):
    """An argument parser that refuses with one sentence, and that is completed when it is used.

    Args:
        command: the module :data:`COMMANDS` of which adds the flags; None: they are added by the caller.
    """

    def __init__(self, *args: Any, command: str | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._command = command

    def complete(self) -> None:
        """Add the flags of the command, if that has not been done."""
        command, self._command = self._command, None
        if command is not None:
            import_module(f"rl2grid.cli.{command}").add_flags(self)
            for parser in _leaves(self):
                _add_output_flags(parser)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As its parent, with all flags."""
        self.complete()
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        words = in_words(message)
        raise UsageError(f"{words[0].upper()}{words[1:]}; see {self.prog} --help.")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    command_line = sys.argv[1:] if arguments is None else list(arguments)
    try:
        with _warnings_as_sentences():
            return _run(command_line)
    except UsageError as error:
        print(f"rl2grid: {printable(str(error))}", file=sys.stderr)
        return REFUSED
    except BrokenPipeError:
        # The reader of our output went away (for example `| head`): nobody is left to tell.
        sys.stderr.close()
        return 0
    except OSError as error:
        print(f"rl2grid: {printable(_about_files(error))}", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        print("rl2grid: interrupted; the same command goes on where it stopped.", file=sys.stderr)
        return INTERRUPTED


def _about_files(error: OSError) -> str:
    """What a disk that is full or may not be written, or a file that is not there, comes to in one sentence."""
    what = f"{error.filename} cannot be read or written" if error.filename else "A file cannot be read or written"
    reason = error.strerror or str(error) or type(error).__name__
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    return f"{what}: {reason}{'; make room, and begin or resume again' if full else ''}."


@contextlib.contextmanager
def _warnings_as_sentences() -> Iterator[None]:
    """Say what was damaged as a sentence, without the line of code that found it."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", DamageWarning)
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
            if issubclass(category, DamageWarning):
                print(f"rl2grid: {printable(str(message))}", file=sys.stderr)
            else:
                usual(message, category, *place, **more)

        warnings.showwarning = show
        yield


def _run(command_line: list[str]) -> int:
    if command_line[:1] == ["train"]:
        from rl2grid.cli.train import train

        return train(command_line[1:])
    parser = make_parser()
    options = parser.parse_args(command_line)
    if not hasattr(options, "run"):
        _chosen(parser, options).print_help()
        return 0
    output = Output(json=options.json, quiet=options.quiet)
    status: int = options.run(options, output)
    output.close()
    return status


def make_parser() -> argparse.ArgumentParser:
    """The parser of all subcommands; ``train`` parses its own flags."""
    parser = Parser(prog="rl2grid", description="A benchmark for reinforcement learning in power-grid operation.")
    parser.add_argument("--version", action="version", version=f"rl2grid {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="command", parser_class=Parser)
    for name, words in COMMANDS.items():
        own = name != "train"
        commands.add_parser(name, help=words, description=_sentence(words), command=name if own else None, add_help=own)
    return parser


def _sentence(words: str) -> str:
    return f"{words[0].upper()}{words[1:]}."


def subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parsers of the subcommands of ``parser`` by name; empty for one that has none."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _leaves(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    below = subparsers(parser)
    return [leaf for each in below.values() for leaf in _leaves(each)] if below else [parser]


def _chosen(parser: argparse.ArgumentParser, options: argparse.Namespace) -> argparse.ArgumentParser:
    """The parser of the command that was named without one of its actions, else that of all."""
    return parser if options.command is None else subparsers(parser)[options.command]


def _add_output_flags(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("output")
    group.add_argument("--json", action="store_true", help="print the results as JSON and nothing else")
    group.add_argument("--quiet", action="store_true", help="print the results alone: no progress, no remarks")
