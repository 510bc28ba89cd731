"""``rl2grid completion``: a script by which a shell completes commands, flags, their values, tasks and agents."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields

from rl2grid.cli.output import Output
from rl2grid.errors import UsageError

SHELLS = ("bash", "zsh")


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument("shell", choices=SHELLS, help="for which shell; docs/command_line.md says where it goes")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    from rl2grid.cli.main import make_parser

    script = _script([*_words(make_parser(), "")], options.shell)
    output.text(script)
    output.results(script=script)
    return 0


@dataclass
class _Words:
    """What may follow one command."""

    path: str
    """The command, as "study run"; empty: none yet."""
    words: list[str] = field(default_factory=list)
    """Commands below, and values of arguments without a flag."""
    flags: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Every flag and the values that it takes; none: of any kind, or none at all."""


def _words(parser: argparse.ArgumentParser, path: str) -> Iterator[_Words]:
    from rl2grid.cli.main import Parser, subparsers

    assert isinstance(parser, Parser)
    parser.complete()
    found = _Words(path)
    if path == "train":
        _add_training(found)
    below = subparsers(parser)
    found.words += below
    for action in parser._actions:
        if action.option_strings:
            found.flags |= dict.fromkeys(action.option_strings, tuple(map(str, action.choices or ())))
        elif not below:
            found.words += _values(action.dest)
            found.words += map(str, action.choices or ())
    yield found
    for name, each in below.items():
        yield from _words(each, f"{path} {name}".strip())


def _values(argument: str) -> Sequence[str]:
    """What an argument of that name may be; files are offered besides."""
    from rl2grid.envs.tasks import all_tasks, short_id
    from rl2grid.grids import system_ids

    if argument == "task":
        return [short_id(task) for task in all_tasks()]
    if argument == "grid":
        return system_ids()
    if argument in ("agent", "agents"):
        from rl2grid.evaluation.agents import AGENTS

        return list(AGENTS)
    return ()


def _add_training(found: _Words) -> None:
    """``rl2grid train`` parses its flags itself; these are those of all algorithms."""
    from rl2grid.algorithms.registry import algorithm_names, find_algorithm
    from rl2grid.cli.train import GIVEN_OTHERWISE, TrainFlags
    from rl2grid.envs.options import options_without
    from rl2grid.evaluation.flags import flag_of

    options = options_without(*GIVEN_OTHERWISE)
    known = [*fields(TrainFlags), *options]
    try:
        known += [each for name in algorithm_names() for each in fields(find_algorithm(name).args)]
    except ImportError as error:
        raise UsageError(
            f"The flags of training need {error.name}: install it with `pip install rl2grid[train]`."
        ) from None
    found.words += [*algorithm_names(), *_values("task")]
    found.flags |= dict.fromkeys(["--help", "--resume", *(f"--{flag_of(each.name)}" for each in known)], ())
    found.flags |= {
        f"--{flag_of(each.name)}": tuple(map(str, each.metadata["choices"]))
        for each in options
        if "choices" in each.metadata
    }


def _script(commands: Sequence[_Words], shell: str) -> str:
    paths = "|".join(shlex.quote(each.path) for each in commands if each.path)
    values = [
        f"        {shlex.quote(f'{each.path} {flag}')}) words={shlex.quote(' '.join(choices))} ;;"
        for each in commands
        for flag, choices in each.flags.items()
        if choices
    ]
    words = [
        f"        {shlex.quote(each.path)}) words={shlex.quote(' '.join(each.words))}; "
        f"flags={shlex.quote(' '.join(each.flags))} ;;"
        for each in commands
    ]
    lines = [
        f"# Completion of rl2grid in {shell}, written by `rl2grid completion {shell}`.",
        *(["autoload -U +X bashcompinit && bashcompinit"] if shell == "zsh" else []),
        "_rl2grid() {",
        '    local word="${COMP_WORDS[COMP_CWORD]}" previous="${COMP_WORDS[COMP_CWORD-1]}"',
        '    local path="" words="" flags="" each',
        '    for each in "${COMP_WORDS[@]:1:COMP_CWORD-1}"; do',
        '        case "${path:+$path }$each" in',
        f'            {paths}) path="${{path:+$path }}$each" ;;',
        "        esac",
        "    done",
        '    case "$path" in',
        *words,
        "    esac",
        '    [[ "$word" == -* ]] && words="$flags"',
        '    case "$path $previous" in',
        *values,
        "    esac",
        '    COMPREPLY=($(compgen -W "$words" -- "$word"))',
        "}",
        "complete -o default -F _rl2grid rl2grid",
    ]
    return "\n".join(lines)
