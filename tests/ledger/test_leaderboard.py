"""Entries of a leaderboard: that replays are exact, and that whatever was changed is noticed."""

from __future__ import annotations

import base64
import copy
import json
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forged import rewrite

from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.protocol import evaluate
from rl2grid.ledger.making import find_evaluation, make_entry
from rl2grid.ledger.verification import check_entry, verify_entry
from rl2grid.records.entries import episode_hash, read_entry, write_entry
from rl2grid.records.episodes import FACTS, OPERATION
from rl2grid.records.evaluations import identity_hash

MONTHS = ["generated/710000-00", "generated/710003-09"]
Contents = dict[str, Any]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Evaluations and entries of an agent that acts at random, on discrete, continuous and joint actions."""
    folder = tmp_path_factory.mktemp("leaderboard")
    for name, task in (("discrete", "bus14-T0"), ("continuous", "bus14-R"), ("joint", "bus14-H0")):
        evaluate("random", task, scenarios=MONTHS, seeds=[0, 1], heuristic="idle", output=folder / name)
        write_entry(folder / f"{name}.json", make_entry(folder / name))
    return folder


@pytest.fixture
def contents(folder: Path) -> Contents:
    contents = json.loads((folder / "discrete.json").read_text())
    del contents["checksum"]  # of the file, by which any change is noticed at once
    return contents


def verify(path: Path, contents: Contents | None = None) -> str | None:
    if contents is not None:
        path.write_text(json.dumps(contents))
    entry = read_entry(path)
    check_entry(entry, str(path))
    return verify_entry(entry)


def rehash(contents: Contents) -> None:
    """What a careful forger would do after a change."""
    contents["identity_hash"] = identity_hash(contents["identity"])
    for episode in contents["episodes"]:
        episode["hash"] = episode_hash({column.name: episode[column.name] for column in (*FACTS, *OPERATION)})


def unpack(episode: Contents) -> Any:
    dtype = np.dtype(episode["dtype"])
    return np.frombuffer(zlib.decompress(base64.b64decode(episode["actions"])), dtype).copy()


def pack(episode: Contents, actions: Any) -> None:
    episode["actions"] = base64.b64encode(zlib.compress(actions.tobytes())).decode()
    episode["shape"] = [len(actions), *episode["shape"][1:]]


@pytest.mark.parametrize("name", ["discrete", "continuous", "joint"])
def test_stored_actions_make_the_same_episodes(folder, name):
    told: list[float] = []
    entry = read_entry(folder / f"{name}.json")
    check_entry(entry, name)
    assert verify_entry(entry, told.append) is None
    assert told == sorted(told)
    assert told[-1] == 4
    assert sum(len(one.actions) for one in entry.episodes) > (10 if name != "joint" else 0)
    assert entry.episodes[0].actions.dtype == (np.uint8 if name == "discrete" else np.float32)


@pytest.mark.parametrize(("entry", "value"), [(0, 50.0), (0, 0.5), (1, 1.5)])
def test_joint_actions_that_are_none_are_refused(folder, tmp_path, entry, value):
    contents = json.loads((folder / "joint.json").read_text())
    del contents["checksum"]
    episode = contents["episodes"][0]
    actions = unpack(episode)
    actions[entry] = value
    episode["actions"] = base64.b64encode(zlib.compress(actions.tobytes())).decode()
    with pytest.raises(UsageError, match="6 values between -1 and 1 behind an id of 0 to 49"):
        verify(tmp_path / "changed.json", contents)


def test_an_entry_is_the_evaluation(folder, contents):
    result = read_entry(folder / "discrete.json").evaluation
    assert [(one.scenario, one.seed) for one in result.episodes] == [(month, s) for month in MONTHS for s in (0, 1)]
    assert result.identity == json.loads((folder / "discrete" / "evaluation.json").read_text())["identity"]
    assert contents["training"] is None
    assert (folder / "discrete.json").stat().st_size < 10_000


def test_a_name_of_its_own_is_kept(folder):
    assert make_entry(folder / "discrete", label="dice").evaluation.summary.agent == "dice"


def _survival(contents: Contents) -> None:
    contents["episodes"][2]["survival"] += 0.1


def _survival_to_the_last_bit(contents: Contents) -> None:
    episode = contents["episodes"][0]
    episode["survival"] = float(np.nextafter(episode["survival"], 1))


def _survival_with_its_hash(contents: Contents) -> None:
    _survival(contents)
    rehash(contents)


def _another_action(contents: Contents) -> None:
    actions = unpack(contents["episodes"][3])
    actions[:] = (actions + 7) % 50
    pack(contents["episodes"][3], actions)


def _no_such_action(contents: Contents) -> None:
    actions = unpack(contents["episodes"][3])
    actions[1] = 50
    pack(contents["episodes"][3], actions)


def _fewer_actions(contents: Contents) -> None:
    pack(contents["episodes"][1], unpack(contents["episodes"][1])[:-1])


def _fewer_actions_and_decisions(contents: Contents) -> None:
    _fewer_actions(contents)
    contents["episodes"][1]["decisions"] -= 1
    rehash(contents)


def _broken_actions(contents: Contents) -> None:
    contents["episodes"][1]["actions"] = contents["episodes"][1]["actions"][:8]


def _unknown_month(contents: Contents) -> None:
    for episode in contents["episodes"][2:]:
        episode["scenario"] = "generated/1-00"
    rehash(contents)


def _another_month(contents: Contents) -> None:
    for episode in contents["episodes"][2:]:
        episode["scenario"] = "generated/710001-07"
    rehash(contents)


def _fewer_episodes(contents: Contents) -> None:
    del contents["episodes"][3]


def _twice(contents: Contents) -> None:
    contents["episodes"][1] = copy.deepcopy(contents["episodes"][0])


def _identity(key: str, value: Any) -> Callable[[Contents], None]:
    def change(contents: Contents) -> None:
        contents["identity"][key] = value
        rehash(contents)

    change.__name__ = key
    return change


def _identity_alone(contents: Contents) -> None:
    contents["identity"]["grid_hash"] = "another"


def _version(contents: Contents) -> None:
    contents["version"] = 2


def _format(contents: Contents) -> None:
    del contents["format"]


def _text_for_a_number(contents: Contents) -> None:
    contents["episodes"][0]["seed"] = "0"


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (_survival, "was changed: the episode generated/710003-09, seed 0 does not have the hash"),
        (_survival_to_the_last_bit, "was changed: the episode generated/710000-00, seed 0 does not have the hash"),
        (_no_such_action, "seed 1 are not ids of 0 to 49"),
        (_fewer_actions, "decisions and"),
        (_broken_actions, "is a damaged entry"),
        (_unknown_month, "generated/1-00"),
        (_another_month, "scenario_pack_hash is"),
        (_fewer_episodes, "is a damaged entry"),
        (_twice, "has an episode twice"),
        (_identity("grid_hash", "another"), "its grid_hash is 'another', that of this installation is"),
        (_identity("action_set_hash", "another"), "its action_set_hash is 'another'"),
        (_identity("task", "rl2grid/bus14-T1-v0"), "its action_set_hash is"),
        (_identity("task", "rl2grid/bus15-T1-v0"), "does not exist"),
        (_identity("start", 5), "another row"),
        (_identity("reward", "some.function"), "its reward is the function some.function"),
        (_identity("reward", "best"), "cannot be played: Reward 'best' does not exist"),
        (_identity("heuristic", "lazy"), "cannot be played: "),
        (_identity("versions", None), "is a damaged entry"),
        (_identity_alone, "was changed: its identity does not have the hash"),
        (_version, "is an entry of version 2"),
        (_format, "is no entry of a leaderboard"),
        (_text_for_a_number, "seed is '0'"),
    ],
)
def test_what_was_changed_is_refused(tmp_path, contents, change, part):
    change(contents)
    with pytest.raises(UsageError, match=re.escape(part)) as refusal:
        verify(tmp_path / "changed.json", contents)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("change", "episode", "part"),
    [
        (_survival_with_its_hash, "generated/710003-09, seed 0", "differs: its survival is stored as"),
        (_another_action, "generated/710003-09, seed 1", ""),
        (_fewer_actions_and_decisions, "generated/710000-00, seed 1", "goes on after its"),
    ],
)
def test_what_the_actions_do_not_make_is_told(tmp_path, contents, change, episode, part):
    change(contents)
    difference = verify(tmp_path / "forged.json", contents)
    assert difference is not None
    assert difference.startswith(f"Episode {episode} ")
    assert part in difference
    assert "then," not in difference  # the versions are those of today


def test_other_versions_are_named_where_numbers_differ(tmp_path, contents):
    _survival_with_its_hash(contents)
    contents["identity"]["versions"]["numba"] = "0.1"
    rehash(contents)
    assert "numba 0.1 then" in (verify(tmp_path / "old.json", contents) or "")


def test_an_evaluation_that_is_played_differently_now_makes_no_entry(folder, tmp_path):
    evaluate("random", "bus14-T0", scenarios=MONTHS[:1], heuristic="idle", output=tmp_path / "random")
    path = tmp_path / "random" / "episodes.csv"
    lines = path.read_text().splitlines()
    place = lines[0].split(",").index("episode_return")
    row = lines[1].split(",")
    row[place] = "1.0"
    path.write_text(f"{lines[0]}\n{','.join(row)}\n")
    rewrite(path.with_name("evaluation.json"), lambda record: record.pop("episodes_sha256"))
    with pytest.raises(UsageError, match=r"is played differently now: its episode_return is stored as 1.0"):
        make_entry(tmp_path / "random")


def test_agents_that_are_not_found_are_asked_for(folder, tmp_path):
    evaluate("random", "bus14-T0", scenarios=MONTHS[:1], heuristic="idle", name="mine", output=tmp_path / "mine")
    with pytest.raises(UsageError, match=r"'mine' of .* was not found: name it with --agent"):
        make_entry(tmp_path / "mine")
    assert verify_entry(make_entry(tmp_path / "mine", agent="random")) is None
    with pytest.raises(UsageError, match="is played differently now"):
        make_entry(tmp_path / "mine", agent="do-nothing")


@pytest.mark.parametrize(
    ("looking", "words"),
    [({"top_k": 3}, "best of 3"), ({"top_k": 2, "rehearse": 6}, "best of 2, rehearsing 6 steps")],
)
def test_a_policy_that_looks_before_it_acts_makes_an_entry(tmp_path, looking, words):
    agent = make_agent("pretrained/bus14-T0", **looking)
    evaluate(agent, "bus14-T0", scenarios=MONTHS[:1], episode_length=60, output=tmp_path / "evaluation")
    entry = make_entry(tmp_path / "evaluation", agent="pretrained/bus14-T0")
    assert entry.label == f"pretrained-bus14-T0, {words}"
    assert verify_entry(entry) is None
    with pytest.raises(UsageError, match="is not greedy as it is now"):
        make_entry(tmp_path / "evaluation", agent="greedy")


def test_a_folder_must_have_one_evaluation(folder, tmp_path):
    assert find_evaluation(folder / "discrete", "test") == folder / "discrete"
    with pytest.raises(UsageError, match="holds no evaluation on test"):
        find_evaluation(tmp_path, "test")
    for name in ("validation", "validation-idle"):
        (tmp_path / "evaluation" / name).mkdir(parents=True)
        (tmp_path / "evaluation" / name / "evaluation.json").write_text("{}")
    with pytest.raises(UsageError, match="holds several evaluations: give one of"):
        find_evaluation(tmp_path, "validation")
