"""Folders in which results are kept when nobody says where."""

from pathlib import Path

from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.places import default_folder


def test_a_policy_of_the_package_has_one_folder_however_it_plays():
    task = find_task("bus14-T0")
    for top_k in (None, 3):
        made = make_agent("pretrained/bus14-T0", task, top_k=top_k)
        folder = default_folder("pretrained/bus14-T0", made, task, "evaluation", f"top-{top_k}")
        assert folder == Path("runs/bus14-T0-v0-pretrained-bus14-T0/evaluation") / f"top-{top_k}"
