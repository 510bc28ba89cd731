"""Validation: what picks the best policy of a run while it is trained."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rl2grid.algorithms.policy_agent import PolicyAgent
from rl2grid.envs.options import changed_options
from rl2grid.evaluation.protocol import at_most, evaluate
from rl2grid.records.summary import safe_episodes
from rl2grid.training.request import RunArgs, find_limits

Evaluate = Callable[[PolicyAgent], Mapping[str, float]]
"""Plays the validation scenarios and returns means over them: ``survival``, under constraints also
``safe_completed``, and whatever else is to be recorded."""

OF_TRAINING = ("split", "scenario", "gamma", "reward")
"""Keywords of the training environments that validation does not take over."""


def validator(args: RunArgs) -> Evaluate:
    """A function that plays the validation scenarios as the run plays its own and returns means over episodes.

    It returns ``survival``, ``completed``, ``episodic_return``, ``cost_lsi``, ``cost_tlo`` and ``decisions``, and
    under constraints ``safe_completed``, P(cost ≤ threshold and episode completed) with the thresholds of
    :func:`rl2grid.training.request.find_limits`.

    Args:
        args: the run: its task, its keywords of the environment and its number of processes are those of validation,
            with the default rewards.

    Raises:
        UsageError: the run cannot be constrained as asked.
    """
    limits = find_limits(args)
    scenarios = at_most(args.task, "validation", args.validation_months)
    heuristic = args.env_keywords.get("heuristic")
    chosen = changed_options(args.env_keywords)
    keywords = {name: value for name, value in chosen.items() if name not in (*OF_TRAINING, "heuristic")}

    def validate(agent: PolicyAgent) -> dict[str, float]:
        result = evaluate(
            agent, args.task, scenarios=scenarios, heuristic=heuristic, workers=args.num_workers, **keywords
        )
        summary = result.summary
        means = {
            "survival": summary.survival.value,
            "completed": summary.completed.value,
            "episodic_return": summary.episode_return.value,
            "cost_lsi": summary.cost_lsi.value,
            "cost_tlo": summary.cost_tlo.value,
            "decisions": summary.decisions.value,
        }
        return {**means, "safe_completed": float(safe_episodes(result.episodes, limits).mean())} if limits else means

    return validate


def find_validator(args: RunArgs) -> Evaluate | None:
    """The :func:`validator` of a run; None for one that asks for no validation.

    Raises:
        UsageError: the run cannot be constrained as asked.
    """
    return None if args.validation_months == 0 else validator(args)


def score(means: Mapping[str, float], limits: Mapping[str, float]) -> tuple[float, ...]:
    """What the best policy has most of, in the order of importance; of equals the latest is kept.

    Under constraints the share of validation episodes that were completed within all ``limits``, then survival;
    without any, survival.
    """
    names = ("safe_completed", "survival") if limits else ("survival",)
    return tuple(float(means[name]) for name in names)
