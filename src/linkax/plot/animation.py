"""Animate a mechanism as a GIF."""

import base64
import io
import os
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from linkax.files import written_whole
from linkax.plot.drawing import draw
from linkax.scenery.scenery import Points, reached, scenery_of
from linkax.simulation.read.solution import Solution

FRAMES_PER_SECOND = 25
MOST_FRAMES = 150
LARGEST_TURN = 0.6  # of a joint between two frames, beyond which a wheel seems to turn the other way [rad]


class Animation:
    """An animated GIF, which a notebook shows as the value of a cell.

    - `gif`: the file as bytes.
    """

    def __init__(self, gif: bytes) -> None:
        self.gif = gif

    def __repr__(self) -> str:
        return f"Animation of {len(self.gif) / 1e6:.1f} MB: a notebook shows it, .gif has its bytes"

    def _repr_html_(self) -> str:
        return f'<img src="data:image/gif;base64,{base64.b64encode(self.gif).decode()}">'


def animate(
    solution: Solution, path: str | os.PathLike | None = None, points: Points | None = None, dpi: int = 100
) -> Animation:
    """Draw an animated GIF of a mechanism: in the plane of its motion, or from a corner where that is spatial.

    Bodies are drawn through their joints and named frames, slides as boxes on their guides, ground under its joints,
    springs, dampers, ropes and massless rods by their symbols, and point masses as discs. The GIF has at most
    150 frames, 25 a second, evenly over the run. Where joints would turn too far between two frames to be followed, it
    shows the beginning of the run only. `Solution.view` shows all of it, in three dimensions.

    **Arguments:**

    - `path`: file to write, ending in `.gif`; none by default.
    - `points`: {name: (body, at)} of points to label and trace, see `Solution.position`.
    - `dpi`: resolution in dots per inch.

    **Returns:** an `Animation`, which a notebook shows.

    **Raises:** `ValueError` for a solution of fewer than two times, and for that of a batch.
    """
    saved = reached(solution)
    if len(saved.ts) < 2:
        raise ValueError(f"a solution of {len(saved.ts)} times cannot be animated; it takes at least two")
    scenery = scenery_of(saved, points or {}, _moments(saved))
    figure, axes, actors = draw(scenery, dpi)
    frames = _filmed(figure, axes, actors, len(scenery.times))
    # One palette for all frames: colours do not flicker, and the file is small.
    palette = frames[0].quantize(128)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    stream, duration = io.BytesIO(), 1000 // FRAMES_PER_SECOND
    frames[0].save(stream, format="GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0)
    animation = Animation(stream.getvalue())
    if path is not None:
        with written_whole(Path(path)) as part:
            part.write_bytes(animation.gif)
    return animation


def _filmed(figure, axes, actors, count) -> list[Image.Image]:
    """Images of all frames; what stands still is drawn once, which is several times faster."""
    canvas = FigureCanvasAgg(figure)
    for actor in actors:
        actor.artist.set_animated(True)
    canvas.draw()
    stage, frames = canvas.copy_from_bbox(figure.bbox), []
    for index in range(count):
        canvas.restore_region(stage)
        for actor in actors:
            actor.move(index)
            axes.draw_artist(actor.artist)
        frames.append(Image.fromarray(np.array(canvas.buffer_rgba())).convert("RGB"))
    return frames


def _moments(solution) -> np.ndarray:
    """The times of the frames [s]."""
    times, v = np.asarray(solution.ts), np.asarray(solution.v)
    turning = np.abs(v[:, ~solution.mechanism.topology.slides])
    fastest = np.maximum.accumulate(np.max(turning, axis=1, initial=0.0))
    turns = fastest * (times - times[0]) / (MOST_FRAMES - 1)
    last = max(1, int(np.sum(turns <= LARGEST_TURN)) - 1)
    return np.linspace(times[0], times[last], MOST_FRAMES)
