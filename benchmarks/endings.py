"""What ends the months that an agent loses: which loss of a line the last overload follows, and whether actions help.

``python benchmarks/endings.py TASK AGENT[:HEURISTIC] [--months N] [--skip N]`` plays validation months and looks at the
lost ones, from the last step in which no line was above its limit on:

- what was lost then: a line that was attacked, one whose maintenance began, or nothing, where demand rises;
- how many steps later the game was over, and why;
- on topology tasks, the worst loading that the best of the level's actions would have left in the next step, by the
  what-if over all of them, when the agent was first asked after that: above 1, no single action ends the overload.

It writes ``benchmarks/results/endings.json``.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gains import validation_months
from witness import Witness, validation_environment

from rl2grid.agents.agent import Action, Agent
from rl2grid.envs.tasks import find_task, short_id
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.episode import play_episode
from rl2grid.mdp.state import GridState
from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "endings.json"


@dataclass
class Crisis:
    """From the last step without an overload to the end of the episode."""

    lost: str
    """What went out of service in the step in which it began."""
    step: int
    """In which it began."""
    loading: float
    """The largest then."""
    best: float | None = None
    """What the best single action would have left."""


class EndWitness(Witness):
    """An agent, and what became of the grid while it played.

    Args:
        agent: who decides.
        tries: whether the actions of the level are tried when a crisis begins.
    """

    def __init__(self, agent: Agent, tries: bool) -> None:
        super().__init__(agent)
        self.tries = tries
        self.crisis: Crisis | None = None
        self._out: Any = None

    def hear(self, state: GridState, row: int) -> None:
        """Note a grid step; that of a game over shows nothing."""
        if state.step[row] == 0:
            self.crisis, self._out = None, None
        if state.terminated[row]:
            return
        out = {"attack": state.attacked[row].copy(), "maintenance": state.time_next_maintenance[row] == 0}
        before, self._out = self._out, out
        loading = float(state.rho[row].max())
        if loading <= 1.0:
            self.crisis = None
        elif self.crisis is None:
            self.crisis = Crisis(_lost(before, out), int(state.step[row]), loading)

    def act(self, observation: Any, info: Any) -> Action:
        """The agent's action."""
        if self.tries and self.crisis is not None and self.crisis.best is None:
            outcomes = self.env.what_if()
            left = np.where(outcomes.legal & (outcomes.verdict == 0), outcomes.worst_loading, np.inf)
            self.crisis.best = float(left.min())
        return super().act(observation, info)


def _lost(before: Any, out: Any) -> str:
    """The lines that went out in a step, and why; two at most."""
    found = [
        f"{why} {line}"
        for why, lines in out.items()
        for line in np.flatnonzero(lines & ~(before[why] if before is not None else np.zeros_like(lines)))
    ]
    return " and ".join(found[:2]) or "demand"


def ends_of(task_id: str, word: str, skip: int, months: int) -> dict[str, Any]:
    """Play the months and say how the lost ones end."""
    task = find_task(task_id)
    name, _, heuristic = word.partition(":")
    witness = EndWitness(make_agent(name, task), tries=task.kind == "T")
    env = validation_environment(witness.agent, task, heuristic or None)
    witness.bind(env)
    lost = []
    for scenario in validation_months(task, skip, months):
        episode = play_episode(witness, env, scenario=scenario, seed=0)
        print(short_id(task.id), word, scenario, round(episode.survival, 3), witness.crisis, flush=True)
        if episode.completed:
            continue
        crisis = witness.crisis or Crisis("nothing: the grid was safe", episode.grid_steps, 0.0)
        lost.append(
            {
                "month": scenario,
                "survival": round(episode.survival, 4),
                "lost": crisis.lost,
                "steps": episode.grid_steps - crisis.step,
                "loading": round(crisis.loading, 3),
                "best_action_leaves": None if crisis.best is None else round(min(crisis.best, 99.0), 3),
                "over": episode.game_over,
                "overloads_at_the_end": episode.last_overloads,
            }
        )
    env.close()
    return {"months": [skip, skip + months], "completed": months - len(lost), "lost": lost}


def main() -> None:
    """Play what is asked for, and write it beside what is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", metavar="TASK")
    parser.add_argument("agent", metavar="AGENT[:HEURISTIC]")
    parser.add_argument("--months", type=int, default=20)
    parser.add_argument("--skip", type=int, default=40)
    arguments = parser.parse_args()
    found = ends_of(arguments.task, arguments.agent, arguments.skip, arguments.months)
    causes = Counter(each["lost"] for each in found["lost"])
    helpless = sum(
        each["best_action_leaves"] is not None and each["best_action_leaves"] > 1.0 for each in found["lost"]
    )
    print(f"{len(found['lost'])} lost, {helpless} of them with no single action that ends the overload:")
    print(json.dumps(dict(causes.most_common()), indent=1))
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results[f"{short_id(find_task(arguments.task).id)} {arguments.agent}"] = found
    write_json(RESULTS, results, indent=1)


if __name__ == "__main__":
    main()
