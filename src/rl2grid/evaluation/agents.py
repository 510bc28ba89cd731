"""Agents by name, from a checkpoint, or of a user's own code."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rl2grid.agents.agent import Agent, SpecialisedAgent
from rl2grid.agents.dc_opf import DcOpf
from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.foresight import Foresight
from rl2grid.agents.greedy import Greedy
from rl2grid.agents.greedy_topology import GreedyN1
from rl2grid.agents.milp import Milp
from rl2grid.agents.planner import Planner
from rl2grid.agents.planner_open import PlannerOpen
from rl2grid.agents.random_agent import RandomAgent
from rl2grid.agents.recovery import Recovery
from rl2grid.agents.rehearsal import Rehearsal
from rl2grid.algorithms.pretrained import is_pretrained
from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError, one_of
from rl2grid.evaluation.own_agents import is_own, load_own_agent
from rl2grid.mdp.features import KINDS

if TYPE_CHECKING:
    from rl2grid.algorithms.policy_agent import PolicyAgent

AGENTS: dict[str, Callable[[], Agent]] = {
    DoNothing.name: DoNothing,
    RandomAgent.name: RandomAgent,
    Recovery.name: Recovery,
    Greedy.name: Greedy,
    GreedyN1.name: GreedyN1,
    Milp.name: Milp,
    DcOpf.name: DcOpf,
    Planner.called: Planner,
    PlannerOpen.called: PlannerOpen,
    Rehearsal.name: Rehearsal,
    Foresight.name: Foresight,
}
"""Agents that need no training, by name."""


def kinds_of(name: str) -> tuple[str, ...]:
    """Kinds of task that an agent of :data:`AGENTS` can play, of :data:`rl2grid.mdp.features.KINDS`."""
    agent = AGENTS[name]
    return agent.kinds if isinstance(agent, SpecialisedAgent) else KINDS


def make_agent(
    spec: str | Path, task: Task | None = None, *, top_k: int | None = None, rehearse: int | None = None
) -> Agent:
    """The agent that ``spec`` asks for.

    Args:
        spec: a name of :data:`AGENTS`, the path of a checkpoint or of a run folder, or where an agent of one's own is
            written, as ``package.module:Agent`` or ``./agent.py`` (:mod:`rl2grid.evaluation.own_agents`).
        task: the task that the agent is to play; checkpoints of other tasks are refused.
        top_k: of a policy: how many of its best actions the what-if compares (:class:`rl2grid.algorithms.top_k.TopK`);
            None: it plays its best.
        rehearse: of a policy: how many grid steps of a crisis are played in imagined worlds first
            (:class:`rl2grid.algorithms.rehearsed.Rehearsed`); None: none are.

    Raises:
        UsageError: there is no such agent, it cannot play the task, or it is no policy and ``top_k`` or ``rehearse``
            was given.
    """
    if str(spec) in AGENTS or is_own(str(spec)):
        _refuse_looking(spec, top_k, rehearse)
    if isinstance(spec, str) and spec in AGENTS:
        return AGENTS[spec]()
    if is_own(str(spec)):
        return load_own_agent(str(spec))
    path = Path(spec)
    if not path.exists() and not is_pretrained(spec):
        others = (
            "the path of a checkpoint",
            "the path of a run folder",
            "pretrained/NAME",
            "package.module:Agent",
            "./agent.py",
        )
        raise one_of("Agent", str(spec), (*AGENTS, *others))
    # Imported here: agents without training run without torch.
    from rl2grid.algorithms.policy_agent import load_agent

    return looking_policy(load_agent(path, task), top_k=top_k, rehearse=rehearse)


def looking_policy(policy: PolicyAgent, *, top_k: int | None = None, rehearse: int | None = None) -> Agent:
    """A policy that looks before it acts, as :func:`make_agent` says; itself if it is not to look.

    Raises:
        UsageError: one of the two is below 1, or the policy has no actions of the kind that is looked at.
    """
    from rl2grid.algorithms.rehearsed import Rehearsed
    from rl2grid.algorithms.top_k import TopK

    player = policy if top_k is None else TopK(policy, top_k)
    return player if rehearse is None else Rehearsed(player, rehearse)


def _refuse_looking(spec: str | Path, top_k: int | None, rehearse: int | None) -> None:
    if top_k is not None:
        raise UsageError(f"top_k compares the best actions of a trained policy: leave it out for {spec}.")
    if rehearse is not None:
        raise UsageError(f"rehearse plays the crises of a trained policy in advance: leave it out for {spec}.")
