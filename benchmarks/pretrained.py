"""Makes a policy that comes with the package of a training run: its weights and its model card.

``python benchmarks/pretrained.py RUN NAME --made-by COMMAND ... --limits TEXT [--beside AGENT ...] [--months N]
[--skip N] [--top-k K] [--rehearse STEPS]`` plays the policy, the policy that looks before it acts in each of the ways
that are asked for, and the agents beside it on N validation months after the first ``--skip``, by which the training
picked its best policy, and writes ``src/rl2grid/algorithms/policies/NAME.pt`` and ``NAME.json``. ``rl2grid pretrained``
shows them.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from gains import validation_months

from rl2grid.agents.agent import Agent
from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.algorithms.policy_agent import BEST_FILE, load_agent
from rl2grid.algorithms.pretrained import LARGEST, ModelCard, Survival, folder
from rl2grid.cli.keywords import add_looking, looking
from rl2grid.envs.tasks import Task, short_id
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import looking_policy, make_agent
from rl2grid.evaluation.protocol import evaluate
from rl2grid.records.files import write_json
from rl2grid.training.request import read_config


def played(agent: Agent, task: Task, months: tuple[str, ...], heuristic: str | None) -> Survival:
    """How long an agent survives."""
    evaluation = evaluate(agent, task, scenarios=months, heuristic=heuristic, workers=0, progress=True)
    survival, completed = evaluation.summary.survival, evaluation.summary.completed
    return Survival(
        agent.name,
        len(months),
        *(round(value, 4) for value in (survival.value, survival.low, survival.high, completed.value)),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("name")
    parser.add_argument("--made-by", nargs="+", required=True)
    parser.add_argument("--limits", required=True)
    parser.add_argument("--beside", nargs="*", default=["do-nothing"])
    parser.add_argument("--months", type=int, default=50)
    parser.add_argument("--skip", type=int, default=20)
    add_looking(parser)
    options = parser.parse_args()

    args, _ = read_config(options.run)
    task, heuristic = args.task, args.env_keywords["heuristic"]
    contents = load_checkpoint(options.run / BEST_FILE)
    months = validation_months(task, options.skip, options.months)
    policy = load_agent(options.run, name=f"pretrained-{options.name}")
    agents: list[Agent] = [policy]
    for way, value in looking(options).items():
        agents.append(looking_policy(load_agent(options.run, name=policy.name), **{way: value}))
    agents += [make_agent(name, task) for name in options.beside]
    card = ModelCard(
        name=options.name,
        task=short_id(task.id),
        heuristic=heuristic,
        algorithm=args.algorithm,
        network=args.hyperparameters.network,  # type: ignore[attr-defined]
        policy_hash=policy.identity["policy_hash"],
        commands=tuple(options.made_by),
        validation=tuple(played(agent, task, months, heuristic) for agent in agents),
        limits=options.limits,
    )
    save_checkpoint(card.file, contents)
    size = card.file.stat().st_size
    if size > LARGEST:
        card.file.unlink()
        raise UsageError(f"The policy has {size:,} bytes, and {LARGEST:,} are allowed: train smaller layers.")
    write_json(folder() / f"{card.name}.json", asdict(card))
    print(json.dumps(asdict(card), indent=1))


if __name__ == "__main__":
    main()
