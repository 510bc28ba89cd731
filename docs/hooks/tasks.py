"""The page of the tasks: its tables and pictures are made from the package while the site is built.

``docs/tasks.md`` names what is to be put in, with ``<!-- tasks: overview -->``, ``<!-- tasks: keywords -->`` and
``<!-- tasks: <grid> -->``. ``docs/index.md`` has one of the pictures, ``<!-- grid: <grid> -->``.
"""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page
from pictures import add_picture, picture_markdown

from rl2grid.drawing.grid_drawing import GridDrawing, Scene, reference_scene
from rl2grid.drawing.theme import Theme, style
from rl2grid.envs.options import option_texts, options_without
from rl2grid.envs.tasks import all_tasks
from rl2grid.grids import GRID_IDS, Grid, load_grid
from rl2grid.grids.grid import Rules
from rl2grid.mdp.actions import continuous_layout
from rl2grid.mdp.features import observation_size

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "tasks.json"
PRACTICALLY_NEVER = 10.0
"""Loading that no line reaches while a power flow exists: the 36-bus grids' hard limit of 200 says "none"."""
_MARK = re.compile(r"<!-- (tasks|grid): (\S+) -->")
_OPPONENTS = {"none": "none", "weighted": "weighted", "geometric": "geometric", "multi_area": "multi-area"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Draw every grid."""
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    for grid_id in GRID_IDS:
        grid = load_grid(grid_id)
        scene = _scene(grid, results[grid_id]["moment"])
        add_picture(files, config, f"grids/{grid_id}", partial(_drawn, grid, scene))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the tables and pictures where the page asks for them."""
    if page.file.src_uri not in ("tasks.md", "index.md"):
        return markdown
    results = json.loads(RESULTS.read_text(encoding="utf-8"))

    def fill(mark: re.Match[str]) -> str:
        kind, name = mark.groups()
        if kind == "grid":
            return _captioned(name, results[name])
        if name == "keywords":
            return _keywords()
        if name == "overview":
            return _overview(results)
        return _of_grid(load_grid(name), results[name])

    return _MARK.sub(fill, markdown)


def _scene(grid: Grid, moment: dict[str, Any]) -> Scene:
    nothing = reference_scene(grid)
    return Scene(
        topo_vect=np.array(moment["topo_vect"], np.int32),
        rho=np.array(moment["rho"], np.float32),
        attacked=nothing.attacked,
        maintained=nothing.maintained,
        highlighted=nothing.highlighted,
        gen_p=np.array(moment["gen_p"], np.float32),
        load_p=np.array(moment["load_p"], np.float32),
        storage_power=np.array(moment["storage_power"], np.float32),
    )


def _drawn(grid: Grid, scene: Scene, theme: Theme) -> Figure:
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(11, 6.2))
        GridDrawing(grid, figure.add_axes((0.01, 0.01, 0.98, 0.98)), theme=theme).show(scene)
    return figure


def _overview(results: dict[str, Any]) -> str:
    rows = ["| grid | substations | lines | generators, loads, storages | opponent | levels | do nothing survives |"]
    rows.append("|---|--:|--:|---|---|--:|---|")
    for grid_id in GRID_IDS:
        grid = load_grid(grid_id)
        opponent = _OPPONENTS[grid.opponent.kind]
        rows.append(
            f"| [{grid_id}](#{grid_id.lower()}) | {grid.n_sub} | {grid.n_line} "
            f"| {grid.n_gen}, {grid.n_load}, {grid.n_storage} | {opponent} | {len(grid.level_sizes)} "
            f"| {_survival(results[grid_id])} |"
        )
    return "\n".join(rows)


def _keywords() -> str:
    texts = option_texts()
    rows = ["| keyword | default | values | meaning |", "|---|---|---|---|"]
    for option in options_without():
        choices = option.metadata.get("choices", ())
        values = ", ".join(f"`{choice!r}`" for choice in choices)
        rows.append(f"| `{option.name}` | `{option.default!r}` | {values} | {texts[option.name]} |")
    return "\n".join(rows)


def _of_grid(grid: Grid, result: dict[str, Any]) -> str:
    return f"{_captioned(grid.id, result)}\n\n{_facts(grid, result)}\n\n{_tasks(grid)}"


def _captioned(grid_id: str, result: dict[str, Any]) -> str:
    """The picture of a grid, and what it shows."""
    moment = result["moment"]
    caption = f"Step {moment['step']:,} of validation month `{moment['scenario']}`: the first emergency."
    return f"{picture_markdown(f'grids/{grid_id}', grid_id)}\n\n*{caption}*"


def _facts(grid: Grid, result: dict[str, Any]) -> str:
    rules, layout = grid.rules, continuous_layout(grid)
    facts = [
        ("grid", f"{grid.n_sub} substations, {grid.n_line} lines, {grid.n_load} loads, {grid.n_storage} storage units"),
        ("generators", f"{grid.n_gen}: {_types(grid)}; together {grid.gen_pmax.sum():,.0f} MW"),
        ("largest demand of a load", f"{grid.load_p_max.max():,.0f} MW"),
        ("maintenance", "planned outages of lines, on working days"),
        ("opponent", _opponent(grid)),
        ("cooldowns", f"{rules.cooldown_line} steps of a line, {rules.cooldown_sub} of a substation"),
        ("protections", _protections(rules)),
        ("continuous action", f"{layout.size} entries: {len(layout.redispatch)} redispatch, {len(layout.curtail)} "
         f"curtailment, {len(layout.storage)} storage"),
        ("do nothing", f"{_survival(result)} of a validation month; "
         f"{result['do_nothing']['completed']:.0%} of the months completed"),
    ]  # fmt: skip
    return "\n".join(["| property | value |", "|---|---|", *(f"| {name} | {text} |" for name, text in facts)])


def _tasks(grid: Grid) -> str:
    rows = ["| task | actions | observation |", "|---|--:|--:|"]
    for task in all_tasks().values():
        if task.grid_id == grid.id and task.constraint is None:
            with_constraints = " (also `-LSI`, `-TLO`)" if task.changes_topology else ""
            actions = f"{task.n_actions:,}" if task.kind == "T" else task.actions_in_words
            rows.append(f"| `{task.id}`{with_constraints} | {actions} | {observation_size(grid, task.kind):,} |")
    return "\n".join(rows)


def _types(grid: Grid) -> str:
    return ", ".join(f"{grid.gen_type.count(kind)} {kind}" for kind in sorted(set(grid.gen_type)))


def _opponent(grid: Grid) -> str:
    opponent = grid.opponent
    if opponent.kind == "none":
        return "none"
    lines = sum(len(area) for area in opponent.areas)
    areas = f" in {len(opponent.areas)} areas" if len(opponent.areas) > 1 else ""
    return (
        f"{_OPPONENTS[opponent.kind]}: attacks one of {lines} lines{areas}, for at most {opponent.max_duration} steps"
    )


def _protections(rules: Rules) -> str:
    at_once = f" or above {rules.hard_overflow:.0%} at once," if rules.hard_overflow < PRACTICALLY_NEVER else ""
    return (
        f"a line trips in its {_ordinal(rules.overflow_allowed + 1)} overloaded step in a row,{at_once} and may be "
        f"closed again after {rules.reconnection} steps"
    )


def _ordinal(number: int) -> str:
    return {3: "third", 4: "fourth"}.get(number, f"{number}th")


def _survival(result: dict[str, Any]) -> str:
    numbers = result["do_nothing"]
    low, high = numbers["interval"]
    return f"{numbers['survival']:.3f} [{low:.3f}, {high:.3f}] ({numbers['months']} months)"
