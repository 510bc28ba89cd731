"""``rl2grid leaderboard``: evaluations as files that anyone can play again, and their ranking."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl2grid.cli import keywords
from rl2grid.cli.output import Output
from rl2grid.cli.scoring import add_scores_flag, scored_table
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.records.entries import PlayableEntry, read_entry, write_entry
from rl2grid.records.evaluations import check_comparable
from rl2grid.records.ledger import HashedTest, add_test, read_ledger
from rl2grid.records.methods import Method
from rl2grid.scenarios.splits import SPLITS

if TYPE_CHECKING:
    from rl2grid.records.evaluations import Evaluation

_SUBJECT = "a run folder, pretrained/NAME, or an agent without training as greedy@bus14-T0 or random@bus14-T0:idle"
_OF_ALL_TASKS = "best", "learned", "untrained", "heuristics"
"""Flags of the tables of a ledger that have a row per task."""
DIFFERENT = 1
"""Exit status when an entry is not what its actions make."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    actions = parser.add_subparsers(dest="action", metavar="action")
    _add_entry(actions)
    _add_test(actions)
    _add_verify(actions)
    _add_table(actions)


def _add_entry(actions: Any) -> None:
    parser = actions.add_parser("entry", help="write an evaluation with all its actions as one file")
    parser.add_argument("folder", type=Path, help="an evaluation, a run that was evaluated, or a cell of a study")
    parser.add_argument("--output", type=Path, required=True, help="the file")
    parser.add_argument("--split", default="validation", choices=SPLITS, help="which evaluation of a run is taken")
    parser.add_argument("--label", default=None, help="what tables call the agent; by default as in the evaluation")
    parser.add_argument("--agent", default=None, help="name, run or checkpoint; by default found by the evaluation")
    parser.set_defaults(run=_entry)


def _add_test(actions: Any) -> None:
    parser = actions.add_parser("test", help="play the test months once, and enter the result in a ledger")
    parser.add_argument("subjects", nargs="*", metavar="subject", help=_SUBJECT)
    parser.add_argument("--ledger", type=Path, required=True, help="the file")
    _add_choices(parser)
    parser.set_defaults(run=_test)


def _add_verify(actions: Any) -> None:
    parser = actions.add_parser("verify", help="play the actions of entries, or tests of a ledger, again and compare")
    parser.add_argument("files", nargs="*", metavar="file", help=f"entries; with --ledger: each {_SUBJECT}")
    parser.add_argument("--ledger", type=Path, default=None, help="compare with the test results of this file")
    _add_choices(parser)
    parser.set_defaults(run=_verify)


def _add_choices(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--months", type=int, default=None, help="the first of the test months; by default all")
    keywords.add_looking(parser)


def _add_table(actions: Any) -> None:
    parser = actions.add_parser("table", help="rank entries by survival, as they are stored")
    parser.add_argument("files", nargs="*", type=Path, metavar="file", help="entries")
    parser.add_argument("--ledger", type=Path, default=None, help="print the test results of this file instead")
    parser.add_argument("--task", dest="only", default=None, help="of a ledger: the rows of this task alone")
    parser.add_argument(
        "--to", default=None, metavar="NAME", help="of a ledger: what rows are compared with, as 'greedy + recovery'"
    )
    parser.add_argument(
        "--best", action="store_true", help="of a ledger: the best of each kind of agent, a row per task"
    )
    parser.add_argument(
        "--learned", action="store_true", help="of a ledger: ways of learning side by side, a row per task"
    )
    parser.add_argument(
        "--untrained", action="store_true", help="of a ledger: doing nothing, search and plans, a row per task"
    )
    parser.add_argument(
        "--heuristics", action="store_true", help="of a ledger: heuristics side by side, a row per task and agent"
    )
    add_scores_flag(parser)
    parser.set_defaults(run=_table)


def _entry(options: argparse.Namespace, output: Output) -> int:
    from rl2grid.ledger.making import find_evaluation, make_entry
    from rl2grid.records.evaluations import load_evaluation

    folder = find_evaluation(options.folder, options.split)
    if not options.output.parent.is_dir():
        raise UsageError(f"Folder {options.output.parent} of the output does not exist.")
    if options.output.exists():
        raise UsageError(f"{options.output} exists already: remove it, or give another name as --output.")
    with output.counting("Playing", len(load_evaluation(folder).episodes)) as show:
        entry = make_entry(folder, agent=options.agent, label=options.label, on_progress=show)
    write_entry(options.output, entry)
    decisions = sum(len(episode.actions) for episode in entry.episodes)
    size = options.output.stat().st_size
    episodes = len(entry.episodes)
    output.results(entry=options.output, episodes=episodes, actions=decisions)
    output.remark(f"{episodes} of {episodes} episodes played as in the evaluation, with {decisions:,} actions.")
    output.remark(f"Written: {options.output} ({size / 1000:,.0f} kB).")
    return 0


def _test(options: argparse.Namespace, output: Output) -> int:
    from rl2grid.ledger.subjects import count_look, find_subject, play_test

    for subject in [find_subject(text, options.months, **keywords.looking(options)) for text in options.subjects]:
        results = read_ledger(options.ledger)
        if subject.digest in results:
            output.remark(f"{subject.agent} on {subject.task.id} has had its test: see {options.ledger.name}.")
            continue
        output.remark(count_look(subject, results))
        add_test(options.ledger, play_test(subject, progress=output.talks))
    output.results(ledger=options.ledger)
    return 0


def _verify(options: argparse.Namespace, output: Output) -> int:
    if options.ledger is not None:
        return _verify_tests(options, output)
    return _verify_entries([Path(file) for file in _some(options.files)], output)


def _verify_tests(options: argparse.Namespace, output: Output) -> int:
    from rl2grid.ledger.subjects import find_subject
    from rl2grid.ledger.verification import verify_test

    found: dict[str, str | None] = {}
    for subject in [find_subject(text, options.months, **keywords.looking(options)) for text in options.files]:
        stored = read_ledger(options.ledger).get(subject.digest)
        if stored is None:
            raise UsageError(f"The ledger has no test of {str(subject.agent)!r} on {subject.task.id} to compare with.")
        difference = verify_test(stored, subject)
        found[str(subject)] = difference
        output.text(f"{subject}: {f'differs in {difference}' if difference else 'the same, bit for bit'}.")
    return _verified(found, output)


def _verify_entries(paths: Sequence[Path], output: Output) -> int:
    from rl2grid.ledger.verification import check_entry, verify_entry

    entries = _read(paths)
    for path, entry in entries.items():
        check_entry(entry, str(path))
    found: dict[str, str | None] = {}
    for path, entry in entries.items():
        with output.counting(f"Playing {path.name}", len(entry.episodes)) as show:
            difference = found[str(path)] = verify_entry(entry, show)
        if difference:
            print(f"rl2grid: {path} is not verified: {difference}.", file=sys.stderr)
        else:
            survival, episodes = entry.evaluation.summary.survival.value, len(entry.episodes)
            output.text(
                f"{path} is verified: survival {survival:.3f} in {episodes} of {episodes} episodes, exactly as stored."
            )
    return _verified(found, output)


def _verified(found: Mapping[str, str | None], output: Output) -> int:
    """The exit status, by how each entry differs; None: not at all."""
    output.results(differences=found)
    return DIFFERENT if any(found.values()) else 0


def _check_what_is_ranked(options: argparse.Namespace) -> None:
    """Refuse files beside a ledger, and flags of the one for the other: they would be passed over in silence."""
    shown = {"--task": options.only, "--to": options.to}
    of_all_tasks = {f"--{name}": getattr(options, name) or None for name in _OF_ALL_TASKS}
    if options.ledger is None:
        for flag, value in {**shown, **of_all_tasks}.items():
            if value is not None:
                raise UsageError(f"{flag} is for the rows of a --ledger: leave it out for entries.")
        return
    asked = [flag for flag, value in of_all_tasks.items() if value is not None]
    if asked and any(value is not None for value in shown.values()):
        raise UsageError(f"{asked[0]} shows all tasks and compares nothing: leave out --task and --to.")
    if len(asked) > 1:
        raise UsageError(f"{' and '.join(asked)} are different tables: ask for one of them.")
    if options.files:
        raise UsageError("Entries and a --ledger do not belong into one table: name the one or the other.")
    if options.l2rpn:
        raise UsageError("--l2rpn is for entries: a ledger does not keep what its episodes cost.")
    if not options.ledger.exists():
        raise UsageError(f"There is no ledger {options.ledger}: give a file that 'rl2grid leaderboard test' wrote.")


def _ledger_text(options: argparse.Namespace, tests: Mapping[str, HashedTest]) -> str:
    from rl2grid.analysis.ledger_heuristics import heuristic_table
    from rl2grid.analysis.ledger_learned import learned_table
    from rl2grid.analysis.ledger_overview import overview_table
    from rl2grid.analysis.ledger_table import ledger_table
    from rl2grid.analysis.ledger_untrained import untrained_table

    if options.best:
        return overview_table(tests)
    if options.learned:
        return learned_table(tests)
    if options.untrained:
        return untrained_table(tests)
    if options.heuristics:
        return heuristic_table(tests)
    return ledger_table(tests, None if options.only is None else find_task(options.only).id, options.to)


def _table(options: argparse.Namespace, output: Output) -> int:
    _check_what_is_ranked(options)
    if options.ledger is not None:
        tests = read_ledger(options.ledger)
        output.text(_ledger_text(options, tests))
        output.results(tests=[asdict(test) for test in tests.values()])
        return 0
    from rl2grid.analysis.result_tables import entry_table
    from rl2grid.analysis.table import table_records

    by_task: dict[str, dict[Path, Evaluation]] = {}
    for path, entry in _read(_some(options.files)).items():
        by_task.setdefault(entry.identity["task"], {})[path] = entry.evaluation
    for results in by_task.values():
        check_comparable(list(results.values()))
    records: dict[str, list[dict[str, object]]] = {}
    for task, evaluations in by_task.items():
        methods = {str(path): Method((result,)) for path, result in evaluations.items()}
        table = entry_table(methods)
        records[task] = table_records(table)
        if not output.json:
            output.table(table, title=task.removeprefix("rl2grid/"))
        if options.l2rpn:
            scores = scored_table(list(methods.values()), output)
            output.table(scores, table_records(scores), title=f"{task.removeprefix('rl2grid/')}, scores of L2RPN")
    output.results(entries=records)
    output.remark("As stored: 'rl2grid leaderboard verify' plays the actions again.")
    return 0


def _some(files: Sequence[Any]) -> Sequence[Any]:
    if not files:
        raise UsageError("No entry was given: name files that 'rl2grid leaderboard entry' wrote, or a --ledger.")
    return files


def _read(paths: Sequence[Path]) -> dict[Path, PlayableEntry]:
    entries: dict[Path, PlayableEntry] = {}
    for path in paths:
        if path in entries:
            raise UsageError(f"{path} was given twice: leave one out.")
        entries[path] = read_entry(path)
    return entries
