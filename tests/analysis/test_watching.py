"""Episodes made visible: what the page embeds and shows, and animations."""

import base64
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib import resources
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from rl2grid.analysis.animation import caption_at, frames, write_animation
from rl2grid.analysis.watch_page import intervals, page_data, topology_changes, write_watch_page
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.records.recordings import Recording

BUS14 = load_grid("bus14")


def made_up(grid, n_steps, game_over="a load was cut off from the grid"):
    """An episode with random loadings, one line attacked for a while, and a substation that is split and restored."""
    random = np.random.default_rng(3)
    shape = (n_steps + 1, grid.n_line)
    topo_vect = np.ones((n_steps + 1, grid.dim_topo), np.int8)
    attacked = np.zeros(shape, np.bool_)
    attacked[3:7, 2] = True
    for position in (grid.line_or_pos_topo_vect[2], grid.line_ex_pos_topo_vect[2]):
        topo_vect[3:7, position] = -1
    first = grid.sub_first_element[1]
    topo_vect[5:9, [first, first + 2]] = 2
    return Recording(
        task=f"rl2grid/{grid.id}-T0-v0",
        agent="someone",
        heuristic="idle",
        scenario="generated/17-03",
        seed=0,
        start=0,
        began="2020-04-01T00:00:00",
        episode_length=8064,
        game_over=game_over,
        line_names=grid.name_line,
        decision_steps=(2, 4),
        actions=("", "substation 1: </script> & <b>"),
        rho=random.uniform(0.1, 1.3, shape).astype(np.float32),
        line_status=~attacked,
        attacked=attacked,
        maintained=np.zeros(shape, np.bool_),
        topo_vect=topo_vect,
        gen_p=random.uniform(0, 50, (n_steps + 1, grid.n_gen)).astype(np.float32),
        load_p=random.uniform(0, 50, (n_steps + 1, grid.n_load)).astype(np.float32),
        storage_power=np.zeros((n_steps + 1, grid.n_storage), np.float32),
        p_or=random.uniform(-50, 50, shape).astype(np.float32),
        gen_p_before_curtail=random.uniform(0, 50, (n_steps + 1, grid.n_gen)).astype(np.float32),
    )


def test_changes_and_intervals_say_what_the_arrays_say():
    random = np.random.default_rng(0)
    topo_vect = random.choice(np.array([-1, 1, 1, 2], np.int8), (30, 8))
    now = np.ones(8, np.int8)
    changes = dict(topology_changes(topo_vect))
    for step, row in enumerate(topo_vect):
        flat = changes.get(step, [])
        now[flat[::2]] = flat[1::2]
        np.testing.assert_array_equal(now, row)
    flags = random.random((30, 5)) < 0.4
    rebuilt = np.zeros_like(flags)
    for line, first, stop in intervals(flags):
        assert not rebuilt[first:stop, line].any()
        rebuilt[first:stop, line] = True
    np.testing.assert_array_equal(rebuilt, flags)


def test_loadings_and_powers_survive_within_their_rounding():
    recording = made_up(BUS14, 20)
    data = page_data(BUS14, recording)
    percent = np.frombuffer(base64.b64decode(data["rho"]), np.uint8).reshape(21, 20)
    on = recording.line_status
    assert np.abs(percent[on] / 100 - recording.rho[on]).max() <= 0.005 + 1e-6
    assert (percent[~on] == 0).all()
    share = np.frombuffer(base64.b64decode(data["power"]), np.uint8).reshape(21, -1) / 255
    powers = np.concatenate((recording.gen_p, recording.load_p), axis=1)
    # The root of the share is rounded to 1/255.
    assert np.abs(np.sqrt(powers / data["largest"]) - share).max() <= 0.5 / 255 + 1e-6


def test_the_page_is_whole_and_needs_nothing_else(tmp_path):
    write_watch_page(tmp_path / "a.html", BUS14, made_up(BUS14, 20))
    text = (tmp_path / "a.html").read_text()
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")
    assert text.count("</script>") == 2
    embedded = text.split("id=episode>")[1].split("</script>")[0]
    assert json.loads(embedded)["decisions"][1] == [4, "substation 1: </script> & <b>"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]


def test_names_neither_break_the_page_nor_enter_it(tmp_path):
    episode = replace(made_up(BUS14, 20), agent="{data}<!--<script>", actions=("{script}", "<!--<script>"))
    write_watch_page(tmp_path / "page.html", BUS14, episode)
    page = (tmp_path / "page.html").read_text()
    assert "<h1>{data}&lt;!--&lt;script&gt; + idle on" in page
    assert "<!--" not in page
    assert page.count("<script") == page.count("</script>") == 2
    (data,) = re.findall(r"id=episode>(.*?)</script>", page)
    assert [words for _, words in json.loads(data)["decisions"]] == ["{script}", "<!--<script>"]


def test_the_legend_has_the_colours_of_the_lines_in_light_and_dark(tmp_path):
    recording = made_up(BUS14, 3)
    write_watch_page(tmp_path / "page.html", BUS14, recording)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    colours = page_data(BUS14, recording)["colours"]
    for percent in (10, 50, 95, 120):
        style = f"--light:{colours['light'][percent]};--dark:{colours['dark'][percent]}"
        assert f"style='{style}' /></svg> {percent}% loaded" in page


def test_a_month_of_the_largest_grid_stays_small(tmp_path):
    grid = load_grid("bus118-MOB-v0")
    write_watch_page(tmp_path / "a.html", grid, made_up(grid, 8064, game_over=""))
    assert (tmp_path / "a.html").stat().st_size < 6e6


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node to run the script of the page")
def test_the_script_says_what_the_recording_says(tmp_path):
    recording = made_up(BUS14, 20)
    (tmp_path / "data.json").write_text(json.dumps(page_data(BUS14, recording)))
    script = str(resources.files("rl2grid.analysis") / "watch_page.js")
    program = f"""
    const {{ Episode }} = require({json.dumps(script)});
    const episode = new Episode(JSON.parse(require("fs").readFileSync({json.dumps(str(tmp_path / "data.json"))})));
    const at = step => {{ episode.seek(step); return {{
      topology: [...episode.topology], worst: episode.worst(step), time: episode.time(step),
      on: episode.grid.lines.map((_, line) => episode.isOn(line)), split: [...episode.splitSubstations()],
      attacked: episode.within(episode.attacked, 2), action: episode.decisionBefore(step) }}; }};
    console.log(JSON.stringify([0, 6, 20, 4].map(at)));
    """
    output = subprocess.run(["node", "-e", program], capture_output=True, text=True, check=True).stdout
    for step, shown in zip((0, 6, 20, 4), json.loads(output), strict=True):
        assert shown["topology"] == recording.topo_vect[step].tolist()
        assert shown["on"] == recording.line_status[step].tolist()
        assert shown["split"] == ([1] if 5 <= step < 9 else [])
        assert shown["attacked"] == (3 <= step < 7)
        assert shown["action"] == (1 if step > 4 else -1)
        loading = np.where(recording.line_status[step], recording.rho[step], 0)
        assert loading[shown["worst"]] >= loading.max() - 0.01
        assert "01 Apr" in shown["time"]


def test_an_animation_holds_every_frame(tmp_path):
    recording = made_up(BUS14, 12)
    pictures = list(frames(BUS14, recording, (0, 4, 6, 12), size=(640, 360)))
    assert (pictures[1] != pictures[2]).any()
    write_animation(tmp_path / "a.gif", iter(pictures))
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.size == (640, 360)
        assert animation.n_frames == 4
        animation.seek(2)
        shown = np.asarray(animation.convert("RGB"), np.int16)
    # One palette for all frames: smoothed edges are off by some shades, the background by none.
    assert (shown[0, 0] == 255).all()
    assert np.abs(shown - pictures[2]).mean() < 1


def test_captions_tell_the_last_action_and_the_ending():
    recording = made_up(BUS14, 12)
    assert caption_at(recording, 4).sentence == "last action: none"
    assert caption_at(recording, 5).sentence.startswith("last action, in step 5: substation 1")
    assert "GAME OVER" in caption_at(recording, 12).sentence
    assert caption_at(recording, 6).headline.startswith("Wed 01 Apr 00:30")


def test_an_interrupted_animation_leaves_no_file(tmp_path):
    def interrupted():
        yield np.zeros((36, 64, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_animation(tmp_path / "a.gif", interrupted())
    assert not list(tmp_path.iterdir())


def test_an_encoder_that_ends_early_is_one_sentence_and_leaves_no_file(tmp_path, monkeypatch):
    written = []

    def encoder(path, *_, **__):
        def taking():
            Path(path).write_bytes(b"begun")
            written.append((yield))
            written.append((yield))
            raise BrokenPipeError(32, "Broken pipe")

        return taking()

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", SimpleNamespace(write_frames=encoder))
    with pytest.raises(UsageError, match=r"ended early; is there room\?"):
        write_animation(tmp_path / "a.mp4", [np.zeros((36, 64, 3), np.uint8)] * 3)
    assert len(written) == 2
    assert not list(tmp_path.iterdir())


def test_refusals(tmp_path, monkeypatch):
    with pytest.raises(UsageError, match=r"\.gif or \.mp4"):
        write_animation(tmp_path / "a.avi", [])
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UsageError, match=r"rl2grid\[video\]"):
        write_animation(tmp_path / "a.mp4", [])
