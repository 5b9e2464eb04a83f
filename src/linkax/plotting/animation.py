"""The mechanism itself as an animation."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image

from linkax.equations.coordinates import rates
from linkax.model.bodies import GROUND_NAME
from linkax.model.joints.bending import OnBeam
from linkax.model.mechanism import Mechanism
from linkax.model.ropes import ElasticRope, Rope
from linkax.plotting.colours import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, SKY, VERMILION
from linkax.simulation.read.observables import Pose
from linkax.simulation.read.solution import Solution

BODY_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)
NEGLIGIBLE = 1e-9  # length of a direction seen from its end
FRAMES_PER_SECOND = 25
MOST_FRAMES = 150
SYMBOL_HEIGHT = 1.8  # of boxes and pivots above ground, in units of a symbol
LARGEST_TURN = 0.6  # radians of a joint between two frames; beyond, an eye loses a wheel's sense of turning


def animate_mechanism(solution: Solution, path, points=None, dpi: int = 100) -> None:
    """Write an animated GIF of the mechanism, in the plane in which it moves most.

    Bodies are drawn through their joints and named frames, slides as boxes on their guides,
    ground under the joints that rest on it, ropes and struts as thin lines, and point masses as
    discs. It has at most 150 frames, 25 a second, evenly over the run; where joints would turn too
    far from one frame to the next to be followed, it shows the beginning of the run only.

    **Arguments:**

    - `path`: file to write, ending in `.gif`.
    - `points`: {name: (body, at)} of points to label and trace (see `Solution.position`).

    **Raises:** `ValueError` for a solution of fewer than two times.
    """
    if len(solution.ts) < 2:
        raise ValueError(f"a solution of {len(solution.ts)} times cannot be animated; it takes at least two")
    moments = _moments(solution)
    scenery = _scenery(moments, points or {})
    figure, axes = _canvas(scenery, dpi)
    _draw_ground(axes, scenery)
    actors = [
        *_draw_slides(axes, scenery),
        *_draw_beams(axes, scenery),
        *_draw_bodies(axes, scenery),
        *_draw_ropes(axes, scenery),
        *_draw_hinges(axes, scenery),
        *_draw_traces(axes, scenery),
        _draw_clock(axes, np.asarray(moments.ts)),
    ]
    frames = _filmed(figure, axes, actors, len(moments.ts))
    # One palette for all frames: colours do not flicker, and the file is small.
    frames = [frame.quantize(palette=frames[0].quantize(128), dither=Image.Dither.NONE) for frame in frames]
    frames[0].save(
        path, format="GIF", save_all=True, append_images=frames[1:], duration=1000 // FRAMES_PER_SECOND, loop=0
    )


class _Actor(NamedTuple):
    """Something that moves: an artist, and what puts it where it is in a frame."""

    artist: Artist
    move: Callable[[int], object]


def _filmed(figure, axes, actors, count) -> list[Image.Image]:
    """All frames; what stands still is drawn once, which is several times faster."""
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


class _Scenery(NamedTuple):
    """What is drawn, over all frames (n_f).

    - `poses`: of each body in each frame, ground included.
    - `outlines`: points of each body in its own frame, (n, 3).
    - `points`: positions of the points to trace, (n_f, 3).
    - `plane`: the two ground axes that span the picture.
    """

    mechanism: Mechanism
    poses: dict[str, Pose]
    outlines: dict[str, np.ndarray]
    points: dict[str, np.ndarray]
    plane: tuple[int, int]

    def seen(self, body, offset) -> np.ndarray:
        """Where a point of a body is in the picture, (n_f, 2)."""
        return _placed(self.poses[body], offset)[:, self.plane]

    @property
    def box(self):
        """Corners that hold everything in all frames, (2, 2): lowest, highest."""
        everything = _everything(self.poses, self.outlines, self.points)[:, self.plane]
        return np.stack([everything.min(axis=0), everything.max(axis=0)])

    @property
    def unit(self) -> float:
        """Size of a symbol [m]."""
        low, high = self.box
        return 0.025 * (max(high - low) or 1.0)


def _scenery(moments, points) -> _Scenery:
    mechanism, count = moments.mechanism, len(moments.ts)
    poses = {name: Pose(*map(np.asarray, pose)) for name, pose in moments.poses().items()}
    poses[GROUND_NAME] = Pose(np.zeros((count, 3)), np.broadcast_to(np.eye(3), (count, 3, 3)))
    outlines = {name: _outline(mechanism, name) for name in poses}
    traced = {name: np.asarray(moments.position(body, at)) for name, (body, at) in points.items()}
    spread = np.ptp(_everything(poses, outlines, traced), axis=0)
    plane = tuple(sorted(np.argsort(-spread, kind="stable")[:2].tolist()))
    return _Scenery(mechanism, poses, outlines, traced, plane)


def _placed(pose, offset):
    return pose.origin + pose.axes @ np.asarray(offset)


def _everything(poses, outlines, points):
    placed = [_placed(poses[name], point) for name, outline in outlines.items() for point in outline]
    return np.concatenate([*placed, *points.values()])


def _outline(mechanism, body) -> np.ndarray:
    """Points of a body that joints, ropes and names mark, and a mass that is concentrated."""
    frames = [frame for joint in mechanism.joints for frame in (joint.parent, joint.child)]
    frames += [point for rope in _ropes(mechanism) for point in rope.points]
    marks = [np.asarray(frame.offset) for frame in frames if frame.body == body]
    if body != GROUND_NAME:
        marks += map(np.asarray, mechanism.body(body).frames.values())
        if _is_concentrated(mechanism, mechanism.body(body)):
            marks.append(np.asarray(mechanism.body(body).center_of_mass))
    return np.unique(np.array(marks), axis=0)


def _ropes(mechanism):
    return [
        element for element in (*mechanism.constraints, *mechanism.forces) if isinstance(element, Rope | ElasticRope)
    ]


def _canvas(scenery, dpi):
    low, high = scenery.box + 3.5 * scenery.unit * np.array([[-1.0], [1.0]])
    width, height = (high - low) * min(6.0 / (high - low)[0], 5.0 / (high - low)[1])
    figure = Figure(figsize=(max(width, 3.0) + 1.0, max(height, 1.6) + 1.0), dpi=dpi, layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel=f"{'xyz'[scenery.plane[0]]} [m]", ylabel=f"{'xyz'[scenery.plane[1]]} [m]")
    axes.grid(True, color="#EEEEEE")
    axes.set_axisbelow(True)
    return figure, axes


def _is_slide(joint):
    return joint.speed_units.count("m") == 1 and not isinstance(joint, OnBeam)


def _is_hinge(joint):
    return "rad" in joint.speed_units and not _is_slide(joint) and not isinstance(joint, OnBeam)


def _draw_clock(axes, times):
    digits = max(2, 2 - int(np.floor(np.log10(times[-1]))))
    clock = axes.set_title(" ", family="monospace", size=12)  # the layout leaves room for a title
    return _Actor(clock, lambda index: clock.set_text(f"t = {times[index]:.{digits}f} s"))


def _draw_ground(axes, scenery):
    """Ground under the hinges that rest on it, and the guides fixed to it."""
    for joint in scenery.mechanism.joints:
        for frame in (joint.parent, joint.child):
            if frame.body == GROUND_NAME and _is_hinge(joint):
                _draw_pivot(axes, scenery.seen(GROUND_NAME, frame.offset)[0], SYMBOL_HEIGHT * scenery.unit)
            elif frame.body == GROUND_NAME and _is_slide(joint):
                _draw_guide(axes, scenery, joint)


def _draw_pivot(axes, tip, size):
    base = tip - [0.0, size]
    half = np.array([0.7 * size, 0.0])
    axes.add_patch(Polygon([tip, base - half, base + half], facecolor="#DDDDDD", edgecolor=INK, zorder=2))
    _draw_hatching(axes, base - 1.5 * half, base + 1.5 * half, size)


def _draw_hatching(axes, start, end, size):
    """A line with ground on its right, seen from start to end."""
    along = (end - start) / np.linalg.norm(end - start)
    count = max(2, round(np.linalg.norm(end - start) / (0.35 * size)))
    roots = start + np.linspace(0.0, 1.0, count + 1)[1:, None] * (end - start)
    strokes = roots + 0.35 * size * (np.array([along[1], -along[0]]) - along)
    axes.plot(*np.stack([start, end]).T, color=INK, linewidth=1.4, zorder=2)
    axes.plot(*np.stack([roots, strokes]).transpose(2, 0, 1), color=INK, linewidth=0.8, zorder=1.5)


def _draw_guide(axes, scenery, joint):
    """The line that a slide on ground runs along, as far as it goes, below its box."""
    way, direction = _slide(scenery, joint)
    if direction is None:
        return
    direction, size = direction[0], SYMBOL_HEIGHT * scenery.unit
    along = (way - way[0]) @ direction
    below = size * np.array([direction[1], -direction[0]])
    start, end = (way[0] + below + reach * direction for reach in (along.min() - 1.5 * size, along.max() + 1.5 * size))
    _draw_hatching(axes, start, end, size)


def _slide(scenery, joint):
    """Way of a slide's moving frame (n_f, 2), and its direction (n_f, 2), None where it is seen from its end."""
    parent, moving = joint.parent, _moving_frame(joint)
    axis = joint.frames()[0][:, 0]
    direction = scenery.seen(parent.body, np.asarray(parent.offset) + axis) - scenery.seen(parent.body, parent.offset)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return scenery.seen(moving.body, moving.offset), direction / length if np.all(length > NEGLIGIBLE) else None


def _moving_frame(joint):
    return joint.child if joint.child.body != GROUND_NAME else joint.parent


def _colour(mechanism, body):
    return BODY_COLOURS[mechanism.topology.bodies.index(body) % len(BODY_COLOURS)]


def _draw_traces(axes, scenery):
    """The way of each named point, and its name beside it."""
    actors = []
    for name, positions in scenery.points.items():
        way = positions[:, scenery.plane]
        axes.plot(*way.T, color=FAINT, linewidth=1.0, linestyle=":", zorder=1)
        backing = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0}
        label = axes.annotate(name, way[0], (0, 13), textcoords="offset points", ha="center", color=INK, bbox=backing)
        actors.append(_Actor(label, lambda index, label=label, way=way: setattr(label, "xy", way[index])))
    return actors


def _draw_bodies(axes, scenery):
    """Each body as the hull of its marked points with a thick round edge, a concentrated mass as a disc."""
    actors = []
    sections = {section for beam in scenery.mechanism.beams for section in beam.sections}
    for body in scenery.mechanism.bodies:
        if body.name in sections:
            continue
        colour, outline = _colour(scenery.mechanism, body.name), scenery.outlines[body.name]
        if len(outline) > 1:
            corners = np.stack([scenery.seen(body.name, mark) for mark in outline], axis=1)
            style = {"color": colour, "linewidth": 8.0, "joinstyle": "round", "capstyle": "round"}
            actors.append(_draw_polygon(axes, list(map(_hull, corners)), style))
        if _is_concentrated(scenery.mechanism, body):
            actors.append(_draw_disc(axes, scenery.seen(body.name, body.center_of_mass), 15, colour, INK))
    return actors


def _draw_beams(axes, scenery):
    """Each beam as a thick line through its sections."""
    actors = []
    for place, beam in enumerate(scenery.mechanism.beams, start=1):
        way = np.stack([scenery.seen(section, np.zeros(3)) for section in beam.sections], axis=1)
        style = {"color": BODY_COLOURS[place % len(BODY_COLOURS)], "linewidth": 6.0}
        actors.append(_draw_line(axes, way, style | {"solid_capstyle": "round", "solid_joinstyle": "round"}))
    return actors


def _draw_ropes(axes, scenery):
    """Each rope, or strut between two points, as a thin line."""
    actors = []
    for rope in _ropes(scenery.mechanism):
        way = np.stack([scenery.seen(point.body, point.offset) for point in rope.points], axis=1)
        actors.append(_draw_line(axes, way, {"color": INK, "linewidth": 1.5}))
    return actors


def _draw_line(axes, way, style):
    (line,) = axes.plot(*way[0].T, **style)
    return _Actor(line, lambda index: line.set_data(*way[index].T))


def _draw_polygon(axes, corners, style):
    patch = axes.add_patch(Polygon(corners[0], **style))
    return _Actor(patch, lambda index: patch.set_xy(corners[index]))


def _is_concentrated(mechanism, body):
    on_slide = any(_is_slide(joint) for joint in mechanism.joints if body.name in (joint.parent.body, joint.child.body))
    return np.all(np.asarray(body.inertia) == 0.0) and body.mass > 0.0 and not on_slide


def _hull(points):
    """Convex hull in the plane, by Andrew's monotone chain."""
    ordered = sorted(map(tuple, points))

    def chain(points):
        hull = []
        for x, y in points:
            while len(hull) > 1 and _turns_right(*hull[-2:], (x, y)):
                hull.pop()
            hull.append((x, y))
        return hull[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]) or ordered[:1])


def _turns_right(first, second, third):
    across = (second[0] - first[0]) * (third[1] - first[1]) - (second[1] - first[1]) * (third[0] - first[0])
    return across <= 0.0


def _draw_slides(axes, scenery):
    """A box on each slide, turned along it, smaller where bodies slide in each other."""
    actors = []
    for joint in filter(_is_slide, scenery.mechanism.joints):
        grounded = GROUND_NAME in (joint.parent.body, joint.child.body)
        height = SYMBOL_HEIGHT * scenery.unit * (1.0 if grounded else 0.5)
        way, direction = _slide(scenery, joint)
        if direction is None:
            continue
        across = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        corners = np.stack([way + height * (1.4 * i * direction + j * across) for i, j in signs], axis=1)
        colour = _colour(scenery.mechanism, _moving_frame(joint).body)
        actors.append(_draw_polygon(axes, corners, {"facecolor": colour, "edgecolor": INK, "linewidth": 1.2}))
    return actors


def _draw_hinges(axes, scenery):
    hinges = [joint.child for joint in scenery.mechanism.joints if _is_hinge(joint)]
    return [_draw_disc(axes, scenery.seen(frame.body, frame.offset), 7, "white", INK) for frame in hinges]


def _draw_disc(axes, way, size, face, edge):
    (disc,) = axes.plot(*way[:1].T, "o", markersize=size, markerfacecolor=face, markeredgecolor=edge)
    return _Actor(disc, lambda index: disc.set_data(*way[index : index + 1].T))
