"""``rl2grid pretrained``: the policies that come with the package, and their cards."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from rl2grid.algorithms.pretrained import PREFIX, ModelCard, cards, pretrained
from rl2grid.analysis.table import Cell, Column, ResultTable, with_interval
from rl2grid.cli.output import Output

_COLUMNS = (
    Column("policy", words=True),
    Column("task", words=True),
    Column("heuristic", words=True),
    Column("made by", words=True),
    Column("survival"),
    Column("looking before it acts", words=True),
    Column("months"),
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument("policy", nargs="?", default=None, help="one of them, to read its card")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    if options.policy is not None:
        return _tell(pretrained(options.policy), output)
    every = cards()
    rows = tuple(tuple(Cell(text) for text in _cells(card)) for card in every)
    table = ResultTable("pretrained", "", _COLUMNS, rows)
    output.table(table, [_record(card) for card in every], title="Survival on validation months")
    output.remark(
        "Play one: `rl2grid watch pretrained/NAME TASK`, looking: `--top-k K`. "
        "How it was made: `rl2grid pretrained NAME`."
    )
    return 0


def _tell(card: ModelCard, output: Output) -> int:
    output.results(**_record(card))
    output.text(f"{PREFIX}{card.name}: {card.algorithm} on {card.task}, network {card.network}.")
    output.text(f"Heuristic: {card.heuristic or 'none'}. Weights: {card.policy_hash}, {_size(card)} kB.")
    output.text("On validation months that nothing was chosen by:")
    for each in card.validation:
        output.text(
            f"  {each.agent}: survival {with_interval(each.estimate, 3)}, {each.completed:.0%} completed, "
            f"{each.months} months"
        )
    output.text("Made by:")
    for command in card.commands:
        output.text(f"  {command}")
    output.text(f"Limits: {card.limits}")
    return 0


def _record(card: ModelCard) -> dict[str, Any]:
    return asdict(card) | {"name": PREFIX + card.name, "kilobytes": _size(card)}


def _cells(card: ModelCard) -> tuple[str, ...]:
    own = card.validation[0]
    survival = with_interval(own.estimate, 3)
    heuristic = card.heuristic or "none"
    return (PREFIX + card.name, card.task, heuristic, card.algorithm, survival, _looking(card), str(own.months))


def _looking(card: ModelCard) -> str:
    """The way of looking by which the policy survives longest, if that is longer than without."""
    own, *others = card.validation
    looking = [each for each in others if each.agent.startswith(own.agent)]
    best = max(looking, key=lambda each: each.survival, default=own)
    return f"{best.survival:.3f} {best.agent.removeprefix(f'{own.agent}, ')}" if best.survival > own.survival else ""


def _size(card: ModelCard) -> int:
    return round(card.file.stat().st_size / 1000)
