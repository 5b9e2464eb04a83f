"""Draw a mechanism with matplotlib: what stands still once, and what moves as `Actor`s."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from linkax.model.bodies import GROUND_NAME
from linkax.plotting.colours import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, SKY, VERMILION
from linkax.plotting.scenery import Scenery, is_concentrated, is_hinge, is_slide, moving_frame, ropes, slide_way

BODY_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)
SYMBOL_HEIGHT = 1.8  # of boxes and pivots above ground, in units of a symbol


class Actor(NamedTuple):
    """An artist that moves, and the function that moves it to its place in a frame, by the frame's index."""

    artist: Artist
    move: Callable[[int], object]


def draw(scenery: Scenery, times: np.ndarray, dpi: int) -> tuple[Figure, Axes, list[Actor]]:
    """Draw all that stands still, and return what moves, from back to front; `times` of the frames [s]."""
    figure, axes = _canvas(scenery, dpi)
    _draw_ground(axes, scenery)
    actors = [
        *_draw_slides(axes, scenery),
        *_draw_beams(axes, scenery),
        *_draw_bodies(axes, scenery),
        *_draw_ropes(axes, scenery),
        *_draw_hinges(axes, scenery),
        *_draw_traces(axes, scenery),
        _draw_clock(axes, times),
    ]
    return figure, axes, actors


def _canvas(scenery, dpi):
    """An empty figure, and axes that hold the scenery in all frames."""
    low, high = scenery.box + 3.5 * scenery.unit * np.array([[-1.0], [1.0]])
    width, height = (high - low) * min(6.0 / (high - low)[0], 5.0 / (high - low)[1])
    figure = Figure(figsize=(max(width, 3.0) + 1.0, max(height, 1.6) + 1.0), dpi=dpi, layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel=f"{'xyz'[scenery.plane[0]]} [m]", ylabel=f"{'xyz'[scenery.plane[1]]} [m]")
    axes.grid(True, color="#EEEEEE")
    axes.set_axisbelow(True)
    return figure, axes


def _draw_clock(axes, times):
    digits = max(2, 2 - int(np.floor(np.log10(times[-1]))))
    clock = axes.set_title(" ", family="monospace", size=12)  # the layout leaves room for a title
    return Actor(clock, lambda index: clock.set_text(f"t = {times[index]:.{digits}f} s"))


def _draw_ground(axes, scenery):
    """Draw ground under its hinges, and the guides fixed to it."""
    for joint in scenery.mechanism.joints:
        for frame in (joint.parent, joint.child):
            if frame.body == GROUND_NAME and is_hinge(joint):
                _draw_pivot(axes, scenery.seen(GROUND_NAME, frame.offset)[0], SYMBOL_HEIGHT * scenery.unit)
            elif frame.body == GROUND_NAME and is_slide(joint):
                _draw_guide(axes, scenery, joint)


def _draw_pivot(axes, tip, size):
    base = tip - [0.0, size]
    half = np.array([0.7 * size, 0.0])
    axes.add_patch(Polygon([tip, base - half, base + half], facecolor="#DDDDDD", edgecolor=INK, zorder=2))
    _draw_hatching(axes, base - 1.5 * half, base + 1.5 * half, size)


def _draw_hatching(axes, start, end, size):
    """Draw a line with hatching on its right, seen from start to end."""
    along = (end - start) / np.linalg.norm(end - start)
    count = max(2, round(np.linalg.norm(end - start) / (0.35 * size)))
    roots = start + np.linspace(0.0, 1.0, count + 1)[1:, None] * (end - start)
    strokes = roots + 0.35 * size * (np.array([along[1], -along[0]]) - along)
    axes.plot(*np.stack([start, end]).T, color=INK, linewidth=1.4, zorder=2)
    axes.plot(*np.stack([roots, strokes]).transpose(2, 0, 1), color=INK, linewidth=0.8, zorder=1.5)


def _draw_guide(axes, scenery, joint):
    """Draw the guide of a slide on ground below its box, as far as the slide goes."""
    way, direction = slide_way(scenery, joint)
    if direction is None:
        return
    direction, size = direction[0], SYMBOL_HEIGHT * scenery.unit
    along = (way - way[0]) @ direction
    below = size * np.array([direction[1], -direction[0]])
    start, end = (way[0] + below + reach * direction for reach in (along.min() - 1.5 * size, along.max() + 1.5 * size))
    _draw_hatching(axes, start, end, size)


def _colour(mechanism, body):
    return BODY_COLOURS[mechanism.topology.bodies.index(body) % len(BODY_COLOURS)]


def _draw_traces(axes, scenery):
    """Draw the path of each named point; its name moves beside it."""
    actors = []
    for name, positions in scenery.points.items():
        way = positions[:, scenery.plane]
        axes.plot(*way.T, color=FAINT, linewidth=1.0, linestyle=":", zorder=1)
        backing = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0}
        label = axes.annotate(name, way[0], (0, 13), textcoords="offset points", ha="center", color=INK, bbox=backing)
        actors.append(Actor(label, lambda index, label=label, way=way: setattr(label, "xy", way[index])))
    return actors


def _draw_bodies(axes, scenery):
    """Draw each body as the hull of its marked points with a thick round edge, a concentrated mass as a disc."""
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
        if is_concentrated(scenery.mechanism, body):
            actors.append(_draw_disc(axes, scenery.seen(body.name, body.center_of_mass), 15, colour, INK))
    return actors


def _draw_beams(axes, scenery):
    """Draw each beam as a thick line through its sections."""
    actors = []
    for place, beam in enumerate(scenery.mechanism.beams, start=1):
        way = np.stack([scenery.seen(section, np.zeros(3)) for section in beam.sections], axis=1)
        style = {"color": BODY_COLOURS[place % len(BODY_COLOURS)], "linewidth": 6.0}
        actors.append(_draw_line(axes, way, style | {"solid_capstyle": "round", "solid_joinstyle": "round"}))
    return actors


def _draw_ropes(axes, scenery):
    """Draw each rope, or strut between two points, as a thin line."""
    actors = []
    for rope in ropes(scenery.mechanism):
        way = np.stack([scenery.seen(point.body, point.offset) for point in rope.points], axis=1)
        actors.append(_draw_line(axes, way, {"color": INK, "linewidth": 1.5}))
    return actors


def _draw_line(axes, way, style):
    (line,) = axes.plot(*way[0].T, **style)
    return Actor(line, lambda index: line.set_data(*way[index].T))


def _draw_polygon(axes, corners, style):
    patch = axes.add_patch(Polygon(corners[0], **style))
    return Actor(patch, lambda index: patch.set_xy(corners[index]))


def _hull(points):
    """Convex hull in the plane, by Andrew's monotone chain."""
    ordered = sorted(map(tuple, points))

    def chain(points):
        hull = []
        for x, y in points:
            while len(hull) > 1 and _turns_right(hull[-2], hull[-1], (x, y)):
                hull.pop()
            hull.append((x, y))
        return hull[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]) or ordered[:1])


def _turns_right(first, second, third):
    across = (second[0] - first[0]) * (third[1] - first[1]) - (second[1] - first[1]) * (third[0] - first[0])
    return across <= 0.0


def _draw_slides(axes, scenery):
    """Draw a box on each slide, in its direction, smaller where bodies slide in each other."""
    actors = []
    for joint in filter(is_slide, scenery.mechanism.joints):
        grounded = GROUND_NAME in (joint.parent.body, joint.child.body)
        height = SYMBOL_HEIGHT * scenery.unit * (1.0 if grounded else 0.5)
        way, direction = slide_way(scenery, joint)
        if direction is None:
            continue
        across = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        corners = np.stack([way + height * (1.4 * i * direction + j * across) for i, j in signs], axis=1)
        colour = _colour(scenery.mechanism, moving_frame(joint).body)
        actors.append(_draw_polygon(axes, corners, {"facecolor": colour, "edgecolor": INK, "linewidth": 1.2}))
    return actors


def _draw_hinges(axes, scenery):
    hinges = [joint.child for joint in scenery.mechanism.joints if is_hinge(joint)]
    return [_draw_disc(axes, scenery.seen(frame.body, frame.offset), 7, "white", INK) for frame in hinges]


def _draw_disc(axes, way, size, face, edge):
    (disc,) = axes.plot(*way[:1].T, "o", markersize=size, markerfacecolor=face, markeredgecolor=edge)
    return Actor(disc, lambda index: disc.set_data(*way[index : index + 1].T))
