"""How agents outlive overloads: by ending them, or by moving them from line to line before protections trip one.

``python benchmarks/crises.py TASK AGENT[:HEURISTIC] ... [--months N] [--skip N]`` plays validation months. A *crisis*
is a row of grid steps in each of which a line is above its limit. Protections trip a line that stays above it for
longer than the rules allow, three steps, so that who outlives a longer crisis has moved the overload from line to line
in time, or lives without the lines that tripped. Of every agent:

- crises, and those that lasted longer than that; how many of the latter were outlived;
- their mean length, and that of the longest that was outlived;
- after how many steps above its limit a line was relieved that stays in service, and how often another line was above
  its limit then, so that the overload was moved and not ended;
- per 100 steps of long crises, lines above their limit that the agent opened, and those that protections tripped;
- attacks on every line, and how many were lost: the game was over before the opponent had let go of the line and no
  line was above its limit.

It writes ``benchmarks/results/crises.json``.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from gains import validation_months
from witness import Witness, validation_environment

from rl2grid.agents.agent import Agent
from rl2grid.arrays import Flags
from rl2grid.envs.tasks import find_task, short_id
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.episode import play_episode
from rl2grid.mdp.rewards import has_tripped
from rl2grid.mdp.state import GridState
from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "crises.json"


@dataclass
class Crisis:
    """A row of steps with an overload."""

    length: int = 0
    outlived: bool = False
    opened: int = 0
    """Lines above their limit that were opened in it."""
    tripped: int = 0
    """Those that protections tripped."""


class CrisisWitness(Witness):
    """An agent, and the crises of the grid while it played."""

    def __init__(self, agent: Agent) -> None:
        super().__init__(agent)
        self.crises: list[Crisis] = []
        self.relieved_after: Counter[int] = Counter()
        """Lines that fell below their limit and stayed in service, by the steps they had been above it."""
        self.moved = 0
        """Of these, how many did while another line was above its limit."""
        self.attacks: Counter[int] = Counter()
        """By line."""
        self.lost: Counter[int] = Counter()
        """Of these, those that were not outlived."""
        self._attacked: set[int] = set()
        """Lines of attacks that are not outlived yet."""
        self._now = Crisis()
        self._above = np.zeros(0, np.int64)

    def hear(self, state: GridState, row: int) -> None:
        """Count a grid step; that of a game over ends the crisis."""
        if state.step[row] == 0:
            self._now, self._above = Crisis(), np.zeros(state.rho.shape[1], np.int64)
            self._attacked = set()
        if state.terminated[row]:
            self._end(outlived=False)
            self.lost.update(self._attacked)
            return
        above = state.rho[row] > 1.0
        self._count_attacks(set(np.flatnonzero(state.attacked[row]).tolist()), bool(above.any()))
        self._count(above, state, row)
        self._above = np.where(above, self._above + 1, 0)
        if above.any():
            self._now.length += 1
        else:
            self._end(outlived=True)

    def _count(self, above: Flags, state: GridState, row: int) -> None:
        """Lines above their limit before this step that it relieved, opened or tripped."""
        before, in_service = self._above > 0, state.line_status[row]
        relieved = before & ~above & in_service
        self.relieved_after.update(self._above[relieved].tolist())
        self.moved += int(relieved.sum()) if above.any() else 0
        out = before & ~in_service & ~state.attacked[row] & (state.time_next_maintenance[row] != 0)
        tripped = sum(has_tripped(state, row, int(line)) for line in np.flatnonzero(out))
        self._now.tripped += tripped
        self._now.opened += int(out.sum()) - tripped

    def _count_attacks(self, now: set[int], overloaded: bool) -> None:
        """Attacks that began in this step, and those that are still to be outlived after it."""
        self.attacks.update(now - self._attacked)
        self._attacked = self._attacked | now if overloaded else now

    def _end(self, outlived: bool) -> None:
        if self._now.length:
            self.crises.append(replace(self._now, outlived=outlived))
        self._now = Crisis()


def crises_of(task_id: str, word: str, skip: int, months: int) -> dict[str, Any]:
    """Play the months and count."""
    task = find_task(task_id)
    name, _, heuristic = word.partition(":")
    witness = CrisisWitness(make_agent(name, task))
    env = validation_environment(witness.agent, task, heuristic or None)
    witness.bind(env)
    survival = []
    for scenario in validation_months(task, skip, months):
        survival.append(play_episode(witness, env, scenario=scenario, seed=0).survival)
        print(short_id(task.id), word, scenario, round(survival[-1], 3), len(witness.crises), flush=True)
    env.close()
    return {"months": [skip, skip + months], "survival": round(float(np.mean(survival)), 4), **_summary(witness)}


def _summary(witness: CrisisWitness) -> dict[str, Any]:
    long = [each for each in witness.crises if each.length > witness.env.grid.rules.overflow_allowed]
    steps = sum(each.length for each in long)
    return {
        "crises": len(witness.crises),
        "outlived": sum(each.outlived for each in witness.crises),
        "long_crises": len(long),
        "long_outlived": sum(each.outlived for each in long),
        "mean_length_of_long": round(steps / len(long), 2) if long else None,
        "longest_outlived": max((each.length for each in witness.crises if each.outlived), default=0),
        "relieved": witness.relieved_after.total(),
        "relieved_while_another_is_above": witness.moved,
        "relieved_after": {str(steps): n for steps, n in sorted(witness.relieved_after.items())},
        "opened_per_100_long_steps": round(100 * sum(each.opened for each in long) / max(steps, 1), 2),
        "tripped_per_100_long_steps": round(100 * sum(each.tripped for each in long) / max(steps, 1), 2),
        "attacks": {str(line): n for line, n in sorted(witness.attacks.items())},
        "attacks_lost": {str(line): n for line, n in sorted(witness.lost.items())},
    }


def main() -> None:
    """Play what is asked for, and write it beside what is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", metavar="TASK")
    parser.add_argument("agents", nargs="+", metavar="AGENT[:HEURISTIC]")
    parser.add_argument("--months", type=int, default=20)
    parser.add_argument("--skip", type=int, default=40)
    arguments = parser.parse_args()
    for word in arguments.agents:
        found = crises_of(arguments.task, word, arguments.skip, arguments.months)
        print(json.dumps(found, indent=1))
        results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        results[f"{short_id(find_task(arguments.task).id)} {word}"] = found
        write_json(RESULTS, results, indent=1)


if __name__ == "__main__":
    main()
