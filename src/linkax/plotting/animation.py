"""Animate a mechanism as a GIF."""

import dataclasses
import os
from functools import partial

import jax
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from linkax.equations.coordinates import rates
from linkax.plotting.drawing import draw
from linkax.plotting.scenery import Points, scenery_of
from linkax.simulation.read.solution import Solution

FRAMES_PER_SECOND = 25
MOST_FRAMES = 150
LARGEST_TURN = 0.6  # of a joint between two frames, beyond which a wheel seems to turn the other way [rad]


def animate_mechanism(
    solution: Solution, path: str | os.PathLike, points: Points | None = None, dpi: int = 100
) -> None:
    """Write an animated GIF of the mechanism, in the plane in which it moves most.

    Bodies are drawn through their joints and named frames, slides as boxes on their guides, ground under its joints,
    ropes and struts as thin lines, and point masses as discs. The GIF has at most 150 frames, 25 a second, evenly
    over the run. Where joints would turn too far between two frames to be followed, it shows the beginning of the run
    only.

    **Arguments:**

    - `path`: file to write, ending in `.gif`.
    - `points`: {name: (body, at)} of points to label and trace, see `Solution.position`.
    - `dpi`: resolution in dots per inch.

    **Raises:** `ValueError` for a solution of fewer than two times.
    """
    if len(solution.ts) < 2:
        raise ValueError(f"a solution of {len(solution.ts)} times cannot be animated; it takes at least two")
    moments = _moments(solution)
    figure, axes, actors = draw(scenery_of(moments, points or {}), np.asarray(moments.ts), dpi)
    frames = _filmed(figure, axes, actors, len(moments.ts))
    # One palette for all frames: colours do not flicker, and the file is small.
    frames = [frame.quantize(palette=frames[0].quantize(128), dither=Image.Dither.NONE) for frame in frames]
    frames[0].save(
        path, format="GIF", save_all=True, append_images=frames[1:], duration=1000 // FRAMES_PER_SECOND, loop=0
    )


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


def _moments(solution) -> Solution:
    """The solution at the times of the frames, by Hermite interpolation of the joints' coordinates."""
    times, q, v = (np.asarray(values) for values in (solution.ts, solution.q, solution.v))
    turning = np.abs(v[:, ~solution.mechanism.topology.slides])
    fastest = np.maximum.accumulate(np.max(turning, axis=1, initial=0.0))
    turns = fastest * (times - times[0]) / (MOST_FRAMES - 1)
    last = max(1, int(np.sum(turns <= LARGEST_TURN)) - 1)
    moments = np.linspace(times[0], times[last], MOST_FRAMES)
    left = np.clip(np.searchsorted(times, moments, side="right") - 1, 0, len(times) - 2)
    width = (times[left + 1] - times[left])[:, None]
    s = (moments - times[left])[:, None] / width
    ends = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * q[left] + (3.0 - 2.0 * s) * s**2 * q[left + 1]
    rate = np.asarray(jax.vmap(partial(rates, solution.mechanism.topology))(q, v))
    slopes = s * (1.0 - s) * width * ((1.0 - s) * rate[left] - s * rate[left + 1])
    return dataclasses.replace(solution, ts=moments, q=ends + slopes, v=v[left])
