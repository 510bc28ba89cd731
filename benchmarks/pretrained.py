"""Makes a policy that comes with the package of a training run: its weights and its model card.

``python benchmarks/pretrained.py RUN NAME --made-by COMMAND ... --limits TEXT [--beside AGENT ...] [--months N]
[--skip N] [--top-k K] [--rehearse STEPS]`` plays the policy, the policy that looks before it acts in each of the ways
that are asked for and in both, and the agents beside it on N validation months after the first ``--skip``, by which
the training picked its best policy, and writes ``src/rl2grid/algorithms/policies/NAME.pt`` and ``NAME.json``.
``rl2grid pretrained`` shows them. Of what would be larger than a policy of the package may be, the critic is kept in
half precision: nobody acts by it, and who goes on from the policy fits it anew.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gains import validation_months

from rl2grid.agents.agent import Agent
from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.algorithms.policy_agent import BEST_FILE, PolicyAgent
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


def packed(file: Path) -> dict[str, Any]:
    """The checkpoint, with a critic that takes half the room where it is too large."""
    contents = load_checkpoint(file)
    if file.stat().st_size > LARGEST:
        weights = contents["policy"]["network"]
        judging = {name: value.half() for name, value in weights.items() if name.startswith("critic.")}
        contents["policy"] = {**contents["policy"], "network": {**weights, **judging}}
    return contents


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
    contents = packed(options.run / BEST_FILE)
    months = validation_months(task, options.skip, options.months)
    policy = PolicyAgent(contents, name=f"pretrained-{options.name}")
    agents: list[Agent] = [policy]
    asked = looking(options)
    ways = [{way: value} for way, value in asked.items()]
    if len(ways) > 1:
        ways.append(asked)
    agents += [looking_policy(PolicyAgent(contents, name=policy.name), **way) for way in ways]
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
