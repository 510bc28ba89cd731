"""One episode of one agent, from reset to ending."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import gymnasium

from rl2grid.agents.agent import Action, Agent, Info, RandomizedAgent, no_intervention
from rl2grid.envs.operation import Operation
from rl2grid.envs.registration import register_all
from rl2grid.errors import UsageError
from rl2grid.evaluation.collapse import COMPLETED, Collapse, collapse, overloaded_lines
from rl2grid.mdp.constraint_table import CONSTRAINTS
from rl2grid.mdp.termination import GameOver
from rl2grid.records.episodes import Episode

OnDecision = Callable[[Action, Info], None]
"""Called with every action of the agent and the ``info`` on which it was chosen."""
OnTransition = Callable[[bool, bool, Info], None]
"""Called with what came of every action of the agent: whether the episode was lost, whether it was completed, and the
``info`` after it."""


TOTALS = (
    *("episode_return", "return_survive", "return_overload", "return_cost"),
    *(constraint.column for constraint in CONSTRAINTS.values()),
)
"""Columns of an episode that are sums over its transitions: reward, its components, costs."""


@dataclass
class Tally:
    """What is added up while an episode is played."""

    totals: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(TOTALS, 0.0))
    """By name of :data:`TOTALS`, what was played before the first decision included."""
    decisions: int = 0
    illegal: int = 0
    ambiguous: int = 0
    seconds: float = 0.0
    """It took."""


def bound_environment(agent: Agent, task: str, keywords: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """An environment to which the agent is bound.

    Args:
        agent: not bound yet.
        task: id of the task.
        keywords: of ``gymnasium.make``.

    Raises:
        UsageError: the environment cannot be made, or the agent cannot play it.
    """
    register_all()
    env = gymnasium.make(task, disable_env_checker=True, **keywords)
    try:
        agent.bind(env)
    except BaseException:
        env.close()
        raise
    return env


def play_episode(
    agent: Agent,
    env: gymnasium.Env[Any, Any],
    *,
    scenario: str,
    seed: int,
    start: int | None = 0,
    on_decision: OnDecision | None = None,
    on_transition: OnTransition | None = None,
) -> Episode:
    """Play one episode with an agent that is bound to ``env``.

    Everything that a transition accrued counts, heuristic steps and those before the first decision
    included. An episode that ends before its first decision is an episode like any other, in which the
    agent is never asked.

    Args:
        agent: bound to ``env``.
        env: made by ``gymnasium.make``.
        scenario: id of the scenario.
        seed: of maintenance, opponent and agent, together with the scenario; see :func:`environment_seed`.
        start: row at which the episode begins; None: drawn in training, else 0.
        on_decision: called at every decision.
        on_transition: called after the transition of every decision.

    Returns:
        What happened, without the labels of an evaluation.

    Raises:
        UsageError: the scenario is not in the split of ``env``, or leaves nothing to play after ``start``; or the agent
            left ``env`` in an imagined world.
    """
    began = time.perf_counter()
    if isinstance(agent, RandomizedAgent):
        agent.seed_episode(seed, _episode_number(scenario, start))
    options = {"scenario": scenario, "start": start}
    observation, info = env.reset(seed=environment_seed(scenario, seed), options=options)
    agent.reset(0)
    tally = Tally()
    _add(tally.totals, float(info["reset_reward"]), info["reset_components"], info["reset_costs"])
    over = False
    played: Any = env.unwrapped
    state = played.state
    while not over:
        # The agent is only asked where the heuristic is not at ease, so that a game over in a later step of the
        # transition, or inside the reset, comes from a state without overloads.
        decided, overloads = info["step"], overloaded_lines(state.rho[0])
        asked = not info["over"]
        if asked:
            action = agent.act(observation, info)
            tally.decisions += 1
            if played.imagined:
                raise UsageError(
                    f"{agent.name} left the environment in an imagined world: restore the true one before acting."
                )
            if on_decision is not None:
                on_decision(action, info)
        else:
            action = no_intervention(env.action_space)
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        if asked and on_transition is not None:
            on_transition(bool(terminated), bool(truncated), info)
        _add(tally.totals, float(reward), info["reward_components"], info["costs"])
        tally.illegal += int(info["illegal"])
        tally.ambiguous += int(info["ambiguous"])
    ending = collapse(state, 0, overloads if info["step"] == decided + 1 else "") if terminated else None
    tally.seconds = time.perf_counter() - began
    return episode_of(scenario, seed, info, tally, ending, played.operation(), played.foresight)


def episode_of(
    scenario: str, seed: int, info: Info, tally: Tally, ending: Collapse | None, operation: Operation, foresight: int
) -> Episode:
    """The row of an episode that is over, without the labels of an evaluation.

    Args:
        scenario: id of the scenario.
        seed: see :func:`play_episode`.
        info: the last one.
        tally: what was added up.
        ending: where the grid was hurt; None: the episode was completed.
        operation: what the episode cost.
        foresight: decisions that were taken where the truth had been seen before.
    """
    hurt = COMPLETED if ending is None else ending
    return Episode(
        scenario=scenario,
        seed=seed,
        start=int(info["start"]),
        episode_length=int(info["episode_length"]),
        grid_steps=int(info["step"]),
        decisions=tally.decisions,
        survival=float(info["survival"]),
        completed=ending is None,
        game_over=GameOver(info["game_over"]).name,
        score_margin=float(info["scores"]["margin"]),
        score_overload=float(info["scores"]["overload"]),
        score_topology=float(info["scores"]["topology"]),
        illegal=tally.illegal,
        ambiguous=tally.ambiguous,
        foresight=foresight,
        wall_time_s=round(tally.seconds, 4),
        last_overloads=hurt.last_overloads,
        last_outages=hurt.last_outages,
        last_cut_off=hurt.last_cut_off,
        **asdict(operation),
        **tally.totals,
    )


def environment_seed(scenario: str, seed: int) -> int:
    """The seed that the environment is reset with: months that are played with one seed share no attack or outage."""
    return (zlib.crc32(scenario.encode()) << 31) + seed


def _add(totals: dict[str, Any], reward: float, components: dict[str, float], costs: dict[str, float]) -> None:
    totals["episode_return"] += reward
    totals["return_survive"] += components["survive"]
    totals["return_overload"] += components["overload"]
    totals["return_cost"] += components["cost"]
    for name, constraint in CONSTRAINTS.items():
        totals[constraint.column] += costs[name]


def _episode_number(scenario: str, start: int | None) -> int:
    """A number for the agent's random stream: scenarios of one seed are to be played differently."""
    return zlib.crc32(f"{scenario}@{start}".encode())
