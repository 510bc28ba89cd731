"""``rl2grid watch``: what it writes, and how it refuses."""

import pytest
from PIL import Image

from rl2grid.cli.main import main
from rl2grid.evaluation import watching


def test_an_episode_is_written_as_page_and_animation(capsys, tmp_path):
    command_line = ["watch", "do-nothing", "bus14-T0", "--split", "bundled", "--steps", "6", "--every", "3"]
    assert main([*command_line, "--output", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "6 of " in output
    (page,), (animation,) = tmp_path.glob("*.html"), tmp_path.glob("*.gif")
    assert str(page) in output.replace("\n", "")
    with Image.open(animation) as pictures:
        assert pictures.n_frames == 3


def test_others_play_the_same_month_on_the_same_page(capsys, tmp_path):
    command_line = ["watch", "do-nothing", "bus14-T0", "--against", "greedy", "--split", "bundled", "--steps", "4"]
    assert main([*command_line, "--every", "4", "--output", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "do-nothing: 4 of " in output
    assert "greedy: 4 of " in output
    assert [path.name for path in sorted(tmp_path.iterdir())] == [
        "bus14-T0-v0-1-do-nothing-bundled-0000-0.gif",
        "bus14-T0-v0-2-greedy-bundled-0000-0.gif",
        "bus14-T0-v0-do-nothing-against-greedy-bundled-0000-0.html",
    ]


def test_a_policy_that_looks_before_it_acts_plays_beside_itself(capsys, tmp_path):
    command_line = ["watch", "pretrained/bus14-T0", "bus14-T0", "--top-k", "3", "--against", "pretrained/bus14-T0"]
    flags = ["--split", "bundled", "--steps", "4", "--format", "html", "--output", str(tmp_path)]
    assert main([*command_line, *flags]) == 0
    output = capsys.readouterr().out
    assert "pretrained-bus14-T0, best of 3: 4 of " in output
    assert "pretrained-bus14-T0: 4 of " in output


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["pretrained/bus14-T0", "bus14-T0", "--top-k", "0"], "top_k=0 is not allowed"),
        (["greedy", "bus14-T0", "--top-k", "3"], "leave it out for greedy"),
        (["pretrained/bus14-T0", "bus14-T0", "--rehearse", "0"], "rehearse=0 is not allowed"),
        (["greedy", "bus14-T0", "--rehearse", "24"], "leave it out for greedy"),
        (["genius", "bus14-T0"], "choose one of do-nothing"),
        (["do-nothing", "bus14-T0", "--against", "genius"], "choose one of do-nothing"),
        (["do-nothing", "bus14-T0", "--against", "dc-opf"], "Agent 'dc-opf' cannot play"),
        (["do-nothing", "bus14-T0", "--steps", "0"], "steps=0 is not allowed"),
        (["do-nothing", "bus14-T0", "--every", "0"], "every=0 is not allowed"),
        (["do-nothing", "bus14-T0", "--seed", "-1"], "seed=-1 is not allowed"),
        (["do-nothing", "bus14-T0", "--scenario", "nowhere"], "nowhere"),
        (["do-nothing", "bus14-T0", "--format", "avi"], "choose from 'html', 'gif', 'mp4'"),
    ],
)
def test_bad_requests_are_refused_with_one_sentence(capsys, tmp_path, flags, words):
    assert main(["watch", *flags, "--output", str(tmp_path / "watched")]) == 2
    (sentence,) = [line for line in capsys.readouterr().err.strip().splitlines() if line.startswith("rl2grid: ")]
    assert words in sentence
    assert not list(tmp_path.iterdir())


def test_nobody_plays_before_all_are_known_to_be_able_to(monkeypatch, tmp_path):
    monkeypatch.setattr(watching, "play_to_watch", lambda *_, **__: pytest.fail("played"))
    assert main(["watch", "do-nothing", "bus14-T0", "--against", "dc-opf", "--output", str(tmp_path / "w")]) == 2
