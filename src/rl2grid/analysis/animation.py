"""Recorded episodes as moving pictures: GIF, or MP4 where an encoder is installed."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgba_array
from numpy.typing import NDArray
from PIL import Image

from rl2grid.drawing.episode_frames import describe_moment
from rl2grid.drawing.grid_drawing import Caption, FrameRenderer, Scene, loading_colours
from rl2grid.drawing.theme import GREEN, LIGHT, PURPLE
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.records.recordings import Recording
from rl2grid.scenarios.scenario import STEP

Frame = NDArray[np.uint8]
FRAMES_PER_SECOND = 12
FORMATS = ("gif", "mp4")


def check_encoder(suffix: str) -> None:
    """Refuse a format that cannot be written here.

    Raises:
        UsageError: it is MP4, and its encoder is not installed.
    """
    if suffix != "mp4":
        return
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        raise UsageError(
            "MP4 needs an encoder: install it with `pip install rl2grid[video]`, or choose --format gif."
        ) from None


def frames(
    grid: Grid, recording: Recording, steps: Iterable[int], size: tuple[int, int] = (1280, 720)
) -> Iterator[Frame]:
    """A picture, uint8 [height, width, 3], for each of ``steps``."""
    renderer = FrameRenderer(grid, size=size)
    for step in steps:
        yield renderer.frame(scene_at(grid, recording, step), caption_at(recording, step))


def scene_at(grid: Grid, recording: Recording, step: int) -> Scene:
    """What ``recording`` shows of the grid at a step."""
    return Scene(
        topo_vect=recording.topo_vect[step].astype(np.int32),
        rho=recording.rho[step],
        attacked=recording.attacked[step],
        maintained=recording.maintained[step],
        highlighted=np.zeros(grid.dim_topo, np.bool_),
        gen_p=recording.gen_p[step],
        load_p=recording.load_p[step],
        storage_power=recording.storage_power[step],
    )


def caption_at(recording: Recording, step: int) -> Caption:
    """Time, worst loading and survival at a step, and the agent's last action before it."""
    line = int(np.argmax(recording.rho[step]))
    acts = [k for k, words in enumerate(recording.actions) if words and recording.decision_steps[k] < step]
    sentence = "last action: none"
    if acts:
        sentence = f"last action, in step {recording.decision_steps[acts[-1]] + 1:,}: {recording.actions[acts[-1]]}"
    if recording.game_over and step == recording.n_steps:
        sentence = f"GAME OVER in the next step: {recording.game_over}"
    clock = datetime.fromisoformat(recording.began) + step * STEP
    loading = float(recording.rho[step, line])
    return describe_moment(clock, step, recording.episode_length, loading, f"line {line}", sentence)


def write_animation(path: Path, pictures: Iterable[Frame]) -> None:
    """Write pictures of one size as ``.gif`` or ``.mp4``, whole or not at all.

    Raises:
        UsageError: the suffix is another one, or the encoder of MP4 is not installed.
    """
    suffix = path.suffix.removeprefix(".")
    if suffix not in FORMATS:
        raise UsageError(f"{path.name} is no animation that can be written: end its name with .gif or .mp4.")
    check_encoder(suffix)
    with _replaced(path) as temporary:
        (_write_gif if suffix == "gif" else _write_mp4)(temporary, iter(pictures))


def _write_gif(path: Path, pictures: Iterator[Frame]) -> None:
    # One palette for all: colours keep their meaning, and no flicker comes of it.
    palette = _palette(Image.fromarray(picture := next(pictures)))
    first = Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
    others = (Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(path, format="GIF", save_all=True, append_images=others, duration=1000 // FRAMES_PER_SECOND, loop=0)


def _palette(picture: Image.Image) -> Image.Image:
    """Colours of a picture and of all loadings, whichever of them the first picture shows."""
    shades = np.rint(255 * loading_colours(LIGHT)(np.linspace(0, 1.01, 160))[:, :3]).astype(np.uint8)
    named = (LIGHT.background, LIGHT.text, LIGHT.muted, LIGHT.out, PURPLE, GREEN)
    marks = np.rint(255 * to_rgba_array(named)[:, :3]).astype(np.uint8)
    common = picture.quantize(90).convert("RGB").getcolors(256) or []
    smooth = np.array([colour for _, colour in common], np.int16)
    # Pillow takes neighbours for one colour: beside the paper's white, an almost white one would be used for it.
    apart = np.abs(smooth[:, None] - marks.astype(np.int16)).max(axis=2).min(axis=1) > 8
    colours = [*marks.tolist(), *smooth[apart].tolist(), *shades.tolist()][:256]
    palette = Image.new("P", (1, 1))
    palette.putpalette([value for colour in colours for value in colour])
    return palette


def _write_mp4(path: Path, pictures: Iterator[Frame]) -> None:
    import imageio_ffmpeg

    first = next(pictures)
    size = (first.shape[1], first.shape[0])
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=FRAMES_PER_SECOND, quality=7, macro_block_size=1)
    writer.send(None)
    try:
        writer.send(np.ascontiguousarray(first))
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
    except OSError:
        raise UsageError(f"{path.name} cannot be written: the encoder of MP4 ended early; is there room?") from None
    finally:
        writer.close()


@contextmanager
def _replaced(path: Path) -> Iterator[Path]:
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
