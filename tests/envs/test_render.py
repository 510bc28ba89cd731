"""Pictures of environments: what changes them, Gymnasium's checker and recorder, and how they are refused."""

import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.drawing.episode_frames import caption_of, scene_of
from rl2grid.envs.grid_env import PowerGridEnv
from rl2grid.errors import UsageError


def make(task_id="bus14-T0", **keywords):
    keywords = {"split": "bundled", "opponent": False, "maintenance": False, **keywords}
    return gymnasium.make(f"rl2grid/{task_id}-v0", **keywords)


@pytest.fixture(scope="module")
def rendered():
    environment = make(render_mode="rgb_array")
    yield environment
    environment.close()


def test_a_picture_shows_the_state_and_the_last_action(rendered):
    rendered.reset(seed=0)
    first = rendered.render()
    assert first.shape == (720, 1280, 3)
    assert first.dtype == np.uint8
    assert (rendered.render() == first).all()
    rendered.step(0)
    assert (rendered.render() != first).any()
    base = rendered.unwrapped
    caption = caption_of(base.grid, base.state, 0, base.clock_at(1), base.describe_action(0))
    assert f"worst loading {base.state.rho.max():.0%}" in caption.headline
    assert f"survived 1 of {base.state.episode_length[0]:,} steps" in caption.headline
    assert caption.sentence == "last action: do nothing"


def test_a_game_over_is_drawn_with_its_topology_and_told(rendered):
    rendered.reset(seed=0)
    random, over = np.random.default_rng(0), False
    while not over:
        _, _, over, completed, info = rendered.step(random.choice(np.flatnonzero(rendered.unwrapped.action_masks())))
        assert not completed
    base = rendered.unwrapped
    scene = scene_of(base.grid, base.state, 0)
    assert (scene.topo_vect == base.state.final_topo_vect[0]).all()
    assert (scene.topo_vect > 0).any()
    assert np.isnan(scene.rho).all()
    caption = caption_of(base.grid, base.state, 0, base.clock_at(1), "")
    assert f"game over after {info['step'] - 1}" in caption.headline
    assert caption.sentence.startswith(info["game_over_text"].split(": ")[1])
    assert rendered.render().shape == (720, 1280, 3)


@pytest.mark.parametrize("kind", ["T0", "R", "H0"])
def test_passes_the_checker_with_pictures(kind):
    environment = make(f"bus14-{kind}", render_mode="rgb_array", disable_env_checker=True)
    with warnings.catch_warnings():
        # Gymnasium advises bounds for the observation space; loadings have none.
        warnings.simplefilter("ignore")
        check_env(environment.unwrapped)
    environment.close()


def test_a_video_can_be_recorded(tmp_path):
    pytest.importorskip("moviepy")
    from gymnasium.wrappers import RecordVideo

    environment = RecordVideo(
        make(render_mode="rgb_array"), str(tmp_path / "videos"), episode_trigger=lambda _: True, video_length=3
    )
    environment.reset(seed=0)
    for _ in range(4):
        environment.step(0)
    environment.close()
    (video,) = tmp_path.glob("videos/*.mp4")
    assert video.stat().st_size > 5_000


def test_refusals():
    with pytest.raises(UsageError, match="choose one of None, rgb_array"):
        PowerGridEnv("bus14-T0", render_mode="ansi")
    silent = make()
    silent.reset(seed=0)
    with pytest.raises(UsageError, match='render_mode="rgb_array"'):
        silent.unwrapped.render()
    with pytest.raises(UsageError, match="call reset first"):
        make(render_mode="rgb_array").unwrapped.render()


def test_without_matplotlib_the_extra_is_named(monkeypatch):
    environment = make(render_mode="rgb_array")
    environment.reset(seed=0)
    for name in [name for name in sys.modules if name.startswith(("rl2grid.drawing", "matplotlib"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr("rl2grid.drawing", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UsageError, match=r"Rendering needs matplotlib.*rl2grid\[analysis\]"):
        environment.render()
