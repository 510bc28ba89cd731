"""Episodes made visible: what the page embeds and shows, and animations."""

import base64
import json
import re
import shutil
import subprocess
import sys
import zlib
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
from rl2grid.records.recordings import Alternative, Cascade, Ending, Reason, Recording, Round, Trip

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


def unpacked(text: str, n_steps: int) -> np.ndarray:
    differences = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(-1, n_steps)
    return np.cumsum(differences, axis=1, dtype=np.uint8).T


def test_loadings_and_powers_survive_within_their_rounding():
    recording = made_up(BUS14, 20)
    data = page_data(BUS14, [recording])
    (episode,) = data["episodes"]
    percent = unpacked(episode["rho"], 21)
    on = recording.line_status
    assert np.abs(percent[on] / 100 - recording.rho[on]).max() <= 0.005 + 1e-6
    assert (percent[~on] == 0).all()
    share = unpacked(episode["power"], 21) / 255
    powers = np.concatenate((recording.gen_p, recording.load_p), axis=1)
    # The root of the share is rounded to 1/255.
    assert np.abs(np.sqrt(powers / data["largest"]) - share).max() <= 0.5 / 255 + 1e-6
    np.testing.assert_array_equal(unpacked(episode["forward"], 21), recording.p_or >= 0)


def test_production_demand_and_weather_add_up():
    recording = made_up(BUS14, 20)
    totals = page_data(BUS14, [recording])["episodes"][0]["totals"]
    megawatts = totals["unit"] * (256.0 * unpacked(totals["high"], 21) + unpacked(totals["low"], 21))
    assert totals["kinds"] == ["nuclear", "thermal", "hydro", "wind", "solar"]
    n = len(totals["kinds"])
    atol = n * totals["unit"]
    np.testing.assert_allclose(megawatts[:, :n].sum(axis=1), recording.gen_p.sum(axis=1), atol=atol)
    np.testing.assert_allclose(megawatts[:, -1], recording.load_p.sum(axis=1), atol=atol)
    for column, kind in enumerate(totals["weather"]):
        gens = [k for k, each in enumerate(BUS14.gen_type) if each == kind]
        expected = recording.gen_p_before_curtail[:, gens].sum(axis=1)
        np.testing.assert_allclose(megawatts[:, n + column], expected, atol=atol)
        assert totals["capacity"][column] == pytest.approx(BUS14.gen_pmax[gens].sum())


def embedded_data(page: str) -> dict:
    (data,) = re.findall(r"id=episode>(.*?)</script>", page)
    return json.loads(data)


def test_the_page_is_whole_and_needs_nothing_else(tmp_path):
    write_watch_page(tmp_path / "a.html", BUS14, [made_up(BUS14, 20)])
    text = (tmp_path / "a.html").read_text()
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")
    assert text.count("</script>") == 2
    data = embedded_data(text)
    (step, number), *_ = data["episodes"][0]["decisions"]
    assert (step, data["words"][number]) == (4, "substation 1: </script> & <b>")
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]


def test_names_neither_break_the_page_nor_enter_it(tmp_path):
    episode = replace(made_up(BUS14, 20), agent="{data}<!--<script>", actions=("{script}", "<!--<script>"))
    write_watch_page(tmp_path / "page.html", BUS14, [episode])
    page = (tmp_path / "page.html").read_text()
    assert "seed 0: {data}&lt;!--&lt;script&gt; + idle</title>" in page
    assert "<!--" not in page
    assert page.count("<script") == page.count("</script>") == 2
    data = embedded_data(page)
    assert [data["words"][k] for _, k in data["episodes"][0]["decisions"]] == ["{script}", "<!--<script>"]


def test_the_legend_has_the_colours_of_the_lines_in_light_and_dark(tmp_path):
    recording = made_up(BUS14, 3)
    write_watch_page(tmp_path / "page.html", BUS14, [recording])
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    colours = page_data(BUS14, [recording])["colours"]
    for percent in (50, 80, 95, 105, 120):
        style = f"--light:{colours['light'][percent]};--dark:{colours['dark'][percent]}"
        assert f"style='{style}' /></svg> {percent}% loaded" in page


def test_scripts_find_every_part_of_the_page(tmp_path):
    write_watch_page(tmp_path / "page.html", BUS14, [made_up(BUS14, 3)])
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    ids = re.findall(r"""\bid=([\w-]+)""", page.split("<script>")[0])
    assert len(ids) == len(set(ids))
    assert set(re.findall(r"""\bat\("([\w-]+)"\)""", page)) <= set(ids)


def test_several_agents_share_a_page():
    one, other = made_up(BUS14, 20), replace(made_up(BUS14, 12), agent="another")
    data = page_data(BUS14, [one, other, one])
    assert [each["label"] for each in data["episodes"]] == [
        "someone + idle (1)",
        "another + idle",
        "someone + idle (2)",
    ]
    assert [each["steps"] for each in data["episodes"]] == [21, 13, 21]


def test_reasons_and_endings_are_told():
    nowhere, nan = float("inf"), float("nan")
    choices = (Alternative("open line 3", 0.876, 0.25, True), Alternative("", nowhere, nan, False))
    lost = np.zeros(BUS14.dim_topo, np.bool_)
    lost[BUS14.load_pos_topo_vect[9]] = True
    ending = Ending(np.ones(BUS14.dim_topo, np.int8), lost, np.zeros(BUS14.n_line, np.bool_))
    recording = replace(made_up(BUS14, 20), reasons=(Reason(4, "probability", "the best", 50, choices),), ending=ending)
    data = page_data(BUS14, [recording])
    (episode,) = data["episodes"]
    assert episode["ending"].endswith("a load was cut off from the grid. Cut off: load 9 (load_12_9).")
    (reason,) = episode["reasons"]
    told = [[data["words"][k], *rest] for k, *rest in reason["alternatives"]]
    assert told == [["open line 3", 87.6, 0.25, 1], ["", "lost", None, 0]]
    assert data["words"][reason["why"]] == "the best"
    # Nothing is known of the rounds: the last frame shows what was left.
    (cascade,) = episode["cascades"]
    assert cascade["step"] == 21
    assert [each["rho"] for each in cascade["rounds"]] == [None]


def test_a_month_of_the_largest_grid_stays_small(tmp_path):
    grid = load_grid("bus118-MOB-v0")
    recording = made_up(grid, 8064, game_over="")
    smooth = np.linspace(0.2, 0.9, 8065, dtype=np.float32)[:, None] * np.ones_like(recording.rho)
    write_watch_page(tmp_path / "a.html", grid, [replace(recording, rho=smooth)])
    assert (tmp_path / "a.html").stat().st_size < 6e6


def run_script(name: str, program: str) -> object:
    script = json.dumps(str(resources.files("rl2grid.analysis") / name))
    asked = f"const script = require({script}); (async () => console.log(JSON.stringify(await ({program})(script))))();"
    return json.loads(subprocess.run(["node", "-e", asked], capture_output=True, text=True, check=True).stdout)


needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="needs Node to run the scripts of the page")


@needs_node
def test_the_script_says_what_the_recording_says(tmp_path):
    recording = made_up(BUS14, 20)
    (tmp_path / "data.json").write_text(json.dumps(page_data(BUS14, [recording])))
    data = json.dumps(str(tmp_path / "data.json"))
    program = f"""async script => {{
      const [episode] = await script.loadEpisodes(JSON.parse(require("fs").readFileSync({data})));
      const at = step => {{ episode.seek(step); return {{
        topology: [...episode.topology], worst: episode.worst(), time: episode.time(step),
        on: episode.grid.lines.map((_, line) => episode.isOn(line)), split: [...episode.splitSubstations()],
        out: episode.outage(2), forward: episode.grid.lines.map((_, line) => episode.runsForward(line)),
        demand: episode.total("demand"), switched: episode.switched() }}; }};
      return {{ steps: [0, 6, 20, 4, 3, 5].map(at), log: episode.log() }};
    }}"""
    said = run_script("watch_episode.js", program)
    for step, shown in zip((0, 6, 20, 4, 3, 5), said["steps"], strict=True):
        assert shown["topology"] == recording.topo_vect[step].tolist()
        assert shown["on"] == recording.line_status[step].tolist()
        assert shown["split"] == ([1] if 5 <= step < 9 else [])
        assert shown["out"] == ("attacked" if 3 <= step < 7 else "out")
        assert shown["forward"] == (recording.p_or[step] >= 0).tolist()
        assert shown["demand"] == pytest.approx(recording.load_p[step].sum(), abs=0.1)
        loading = np.where(recording.line_status[step], recording.rho[step], 0)
        assert loading[shown["worst"]] >= loading.max() - 0.01
        assert "01 Apr" in shown["time"]
    nothing = {"lines": [], "subs": []}
    switched = [shown["switched"] for shown in said["steps"]]
    assert switched == [nothing, nothing, nothing, nothing, {"lines": [2], "subs": []}, {"lines": [], "subs": [1]}]
    assert [(step, kind) for step, kind, _ in said["log"]] == [(3, "attack"), (5, "agent"), (20, "agent end")]


@needs_node
def test_the_script_walks_through_a_cascade(tmp_path):
    recording = lost_by_a_cascade()
    (tmp_path / "data.json").write_text(json.dumps(page_data(BUS14, [recording])))
    data = json.dumps(str(tmp_path / "data.json"))
    program = f"""async script => {{
      const [episode] = await script.loadEpisodes(JSON.parse(require("fs").readFileSync({data})));
      const at = round => {{ episode.seek(21, round); return {{
        on: [4, 6].map(line => episode.isOn(line)), loading: episode.loading(6), flow: episode.hasFlow,
        cut: episode.cutOff(), round: episode.round }}; }};
      return {{ last: episode.last, rounds: episode.rounds(21), shown: [0, 1, 2, 9].map(at), log: episode.log() }};
    }}"""
    said = run_script("watch_episode.js", program)
    assert (said["last"], said["rounds"]) == (21, 3)
    assert [each["on"] for each in said["shown"]] == [[True, True], [False, True], [False, False], [False, False]]
    assert [each["loading"] for each in said["shown"]] == [90, 305, 0, 0]
    assert [each["flow"] for each in said["shown"]] == [True, True, False, False]
    load = int(BUS14.load_pos_topo_vect[9])
    assert [each["cut"] for each in said["shown"]] == [[], [], [load], [load]]
    words = [words for _, kind, words in said["log"] if kind == "trip"]
    assert "line 4 (1_4_4) at 107%: overloaded for 3 steps" in words[0]
    assert "line 6 (3_4_6) at 305%: above the hard limit" in words[1].replace(BUS14.name_line[6], "3_4_6")


def lost_by_a_cascade() -> Recording:
    """Line 4 trips, then line 6, and load 9 is cut off."""
    recording = made_up(BUS14, 20)
    rounds, topo_vect = [], recording.topo_vect[-1].copy()
    for trip, rho in ((Trip(4, 1.07, 3), 0.9), (Trip(6, 3.05, 0), 3.05), (None, np.nan)):
        loading = np.full(BUS14.n_line, rho, np.float32)
        rounds.append(Round(topo_vect.copy(), loading, loading, () if trip is None else (trip,)))
        if trip is not None:
            topo_vect[[BUS14.line_or_pos_topo_vect[trip.line], BUS14.line_ex_pos_topo_vect[trip.line]]] = -1
    lost = np.zeros(BUS14.dim_topo, np.bool_)
    lost[BUS14.load_pos_topo_vect[9]] = True
    ending = Ending(topo_vect, lost, np.zeros(BUS14.n_line, np.bool_))
    return replace(recording, cascades=(Cascade(21, tuple(rounds)),), ending=ending)


@needs_node
@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("line 3", ["line", 3]),
        ("Load_4_3", ["load", 3]),
        ("generator 1 (gen_2_1)", ["generator", 1]),
        ("7", ["substation", 7]),
        ("sub_13", ["substation", 13]),
        ("load_1", None),
        ("nothing of the kind", None),
        ("", None),
    ],
)
def test_things_are_found_by_number_and_name(words, found, tmp_path):
    (tmp_path / "grid.json").write_text(json.dumps(page_data(BUS14, [made_up(BUS14, 2)])["grid"]))
    grid = f"JSON.parse(require('fs').readFileSync({json.dumps(str(tmp_path / 'grid.json'))}))"
    thing = run_script("watch_map.js", f"script => script.findThing({grid}, {json.dumps(words)})")
    assert (thing and [thing["kind"], thing["number"]]) == found


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
