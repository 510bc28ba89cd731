"""Where what an agent has done on a task is stored, when nobody says where."""

from __future__ import annotations

from pathlib import Path

from rl2grid.agents.agent import Agent
from rl2grid.algorithms.pretrained import is_pretrained
from rl2grid.envs.tasks import Task
from rl2grid.evaluation.own_agents import is_own
from rl2grid.records.files import in_file_name


def default_folder(agent: str | Path, made: Agent, task: Task, kind: str, name: str) -> Path:
    """Inside the run for one of its policies; else by task and agent.

    Args:
        agent: what was asked for.
        made: the agent that it stands for.
        task: that it plays.
        kind: of what is stored, as ``evaluation``: a folder.
        name: of the folder below, by which the same agent's are told apart.
    """
    path = Path(agent)
    if path.is_dir():
        return path / kind / name
    if path.is_file() and not is_own(str(agent)):
        return path.parent / kind / f"{path.stem}-{name}"
    return Path("runs") / f"{task.id.removeprefix('rl2grid/')}-{_in_paths(str(agent), made)}" / kind / name


def _in_paths(agent: str, made: Agent) -> str:
    """What folders call an agent; one of a user's own gets another folder whenever its file has changed."""
    if is_pretrained(agent):
        return in_file_name(Path(agent).as_posix())
    if not is_own(agent):
        return agent
    name = in_file_name(made.name)
    version = getattr(made, "identity", None)
    source = version.get("source_hash", "") if isinstance(version, dict) else ""
    return f"{name}-{source[:8]}" if source else name
