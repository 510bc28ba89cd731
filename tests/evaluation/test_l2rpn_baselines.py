"""L2RPN's scores: against Grid2Op's own classes on the same series, and what is remembered and stored of them."""

import bz2
import shutil
import warnings
from pathlib import Path

import grid2op
import numpy as np
import pytest
from grid2op.Agent import BaseAgent
from grid2op.utils import ScoreL2RPN2022, ScoreL2RPN2023
from lightsim2grid import LightSimBackend

from rl2grid.agents.agent import Agent
from rl2grid.errors import UsageError
from rl2grid.evaluation import l2rpn
from rl2grid.evaluation.l2rpn import l2rpn_scores
from rl2grid.evaluation.protocol import evaluate
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import decode_continuous
from rl2grid.records.l2rpn import L2RPN_FILE, read_scores
from rl2grid.scenarios import full
from rl2grid.scenarios.bundled import bundled_folders

GRID = load_grid("bus14")
SERIES, FIRST, ROWS, FACTOR = "0000", 150, 61, 1.3
"""With so much demand doing nothing loses the grid after a while."""
TOLERANCE = 0.01
"""Of scores from -100 to 100: Grid2Op adds up in float32."""


class Scripted(Agent):
    """Redispatches and curtails by rote, on this side."""

    name = "scripted"

    def reset(self, row):
        self._step = 0

    def act(self, observation, info):
        self._step += 1
        return script(self._step)


class ScriptedThere(BaseAgent):
    """The same on Grid2Op's."""

    def reset(self, obs):
        self._step = 0

    def act(self, observation, reward, done=False):
        self._step += 1
        injection = decode_continuous(GRID, script(self._step))
        return self.action_space({"redispatch": injection.redispatch, "curtail": injection.curtailment_limit})


def script(step):
    rng = np.random.default_rng(step // 6)
    return rng.uniform(-0.3, 0.1, 6).astype(np.float32)


@pytest.fixture
def dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A downloaded dataset: the bundled one, of which one series is there, some rows long."""
    bundled = bundled_folders(GRID)[SERIES]
    folder = tmp_path / "data" / "l2rpn_case14_sandbox"
    shutil.copytree(bundled.parents[1], folder, ignore=shutil.ignore_patterns("chronics", "__pycache__"))
    write_series(bundled, folder / "chronics" / SERIES, FACTOR)
    monkeypatch.setenv("RL2GRID_FULL_DATA", str(folder.parent))
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "own"))
    full._folders.cache_clear()
    return folder


def write_series(source: Path, target: Path, factor: float) -> None:
    """Some rows of a series, with ``factor`` times the demand; the balancing generator meets it."""
    target.mkdir(parents=True)
    for path in source.iterdir():
        if path.suffix != ".bz2":
            shutil.copy(path, target)
            continue
        head, *rows = bz2.decompress(path.read_bytes()).decode().splitlines()
        scale = factor if path.name.startswith("load") else 1.0
        values = np.array([row.split(";") for row in rows[FIRST : FIRST + ROWS]], np.float64) * scale
        lines = [head, *(";".join(f"{value:.4f}" for value in row) for row in values)]
        (target / path.name).write_bytes(bz2.compress(("\n".join(lines) + "\n").encode()))


def play(agent, **keywords):
    scenarios = [f"full/{SERIES}"]
    return evaluate(agent, "bus14-R", split="train", scenarios=scenarios, maintenance=False, **keywords)


def score_there(kind, dataset: Path, agent):
    """What a class of Grid2Op makes of an agent."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        environment = grid2op.make(str(dataset), backend=LightSimBackend())
        scorer = kind(environment, nb_scenario=1, env_seeds=[0], agent_seeds=[0])
        scores, survived, steps = scorer.get(agent(environment.action_space))
        scorer.clear_all()
        environment.close()
    return scores[0], survived[0], steps[0]


@pytest.mark.slow
def test_scores_of_2020_and_2023_are_those_of_grid2op(dataset: Path):
    """``ScoreL2RPN2023`` computes that of 2020, its operational part, by the code of ``ScoreL2RPN2020``."""
    result = play(Scripted(), dispatch="grid2op")
    (scores,) = l2rpn_scores(result)
    (_, operational, renewable, _), survived, steps = score_there(ScoreL2RPN2023, dataset, ScriptedThere)
    assert (result.episodes[0].grid_steps, result.episodes[0].episode_length) == (survived, steps)
    assert scores.score_2020 == pytest.approx(operational, abs=TOLERANCE)
    assert scores.renewable_2023 == pytest.approx(renewable, abs=TOLERANCE)
    assert scores.score_2023 == pytest.approx((0.6 * operational + 0.15 * renewable) / 0.75, abs=TOLERANCE)
    assert 0 < abs(scores.score_2020) < 100


@pytest.mark.slow
def test_the_score_of_2022_is_that_of_grid2op(dataset: Path):
    (scores,) = l2rpn_scores(play(Scripted(), dispatch="grid2op"))
    score, _, _ = score_there(ScoreL2RPN2022, dataset, ScriptedThere)
    assert scores.score_2022 == pytest.approx(score, abs=TOLERANCE)


def test_doing_nothing_scores_nothing_and_loses_the_grid(dataset: Path):
    result = play("do-nothing")
    (scores,) = l2rpn_scores(result)
    assert not result.episodes[0].completed
    assert scores.score_2020 == scores.score_2022 == 0


def test_a_week_of_a_full_dataset_is_scored_and_remembered(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    told = []
    result = play("do-nothing", episode_length=40, output=tmp_path / "evaluation")
    scores = l2rpn_scores(result, told.append)
    assert result.episodes[0].episode_length == 40
    assert result.identity["episode_length"] == 40
    assert told == [0, 1]
    assert read_scores(tmp_path / "evaluation", result.episodes) == scores
    monkeypatch.setattr(l2rpn._Crew, "play", None)  # nothing is played again
    assert l2rpn_scores(result) == scores
    (tmp_path / "evaluation" / L2RPN_FILE).write_text("{}")
    with pytest.raises(UsageError, match="is no file of L2RPN's scores"):
        read_scores(tmp_path / "evaluation", result.episodes)


def test_a_length_that_does_not_fit_is_refused_before_anything_is_played(dataset: Path, tmp_path: Path):
    with pytest.raises(UsageError, match=r"^episode_length=61 is longer than scenario full/0000, which has 60 steps"):
        play("do-nothing", episode_length=61, output=tmp_path / "evaluation")
    assert not (tmp_path / "evaluation").exists()
