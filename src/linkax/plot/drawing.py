"""Draw a mechanism with matplotlib: what stands still once, and what moves as `Actor`s."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from linkax.model.bodies import GROUND_NAME
from linkax.plot.figure import Figure
from linkax.scenery.colours import FAINT, INK, body_colour
from linkax.scenery.scenery import Scenery, is_concentrated, is_hinge, is_slide, moving_frame, spans

NEGLIGIBLE = 1e-9  # length in the picture up to which a direction is seen from its end
SYMBOL_HEIGHT = 1.8  # of boxes and pivots above ground, in units of a symbol


class Actor(NamedTuple):
    """An artist that moves, and the function that moves it to its place in a frame, by the frame's index."""

    artist: Artist
    move: Callable[[int], object]


def draw(scenery: Scenery, dpi: int) -> tuple[Figure, Axes, list[Actor]]:
    """Draw all that stands still, and return what moves, from back to front."""
    figure, axes = _canvas(scenery, dpi)
    unit = 0.025 * (max(scenery.box[1] - scenery.box[0]) or 1.0)  # size of a symbol [m]
    _draw_ground(axes, scenery, unit)
    actors = [
        *_draw_slides(axes, scenery, unit),
        *_draw_bodies(axes, scenery),
        *_draw_spans(axes, scenery, unit),
        *_draw_hinges(axes, scenery),
        *_draw_points(axes, scenery),
        _draw_clock(axes, scenery.times),
    ]
    return figure, axes, actors


def _canvas(scenery, dpi):
    """An empty figure, and axes that hold the scenery at all times."""
    extent = max(scenery.box[1] - scenery.box[0]) or 1.0
    low, high = scenery.box + 0.0875 * extent * np.array([[-1.0], [1.0]])
    if scenery.camera.plane is None:
        low[1] -= 0.1 * extent  # for the compass
    width, height = (high - low) * min(6.0 / (high - low)[0], 5.0 / (high - low)[1])
    figure = Figure(figsize=(max(width, 3.0) + 1.0, max(height, 1.6) + 1.0), dpi=dpi, layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    if scenery.camera.plane is None:
        axes.set_axis_off()
        _draw_compass(axes, scenery.camera, low, high)
        return figure, axes
    right, up = ("xyz"[axis] for axis in scenery.camera.plane)
    axes.set(xlabel=f"{right} [m]", ylabel=f"{up} [m]")
    axes.grid(True, color="#EEEEEE")
    axes.set_axisbelow(True)
    return figure, axes


def _draw_compass(axes, camera, low, high):
    """Draw the directions of the ground axes, and a length to compare with, below at the left."""
    reach = 0.09 * max(high - low)
    root = low + 1.2 * reach
    for name, direction in zip("xyz", camera.seen(np.eye(3)), strict=True):
        axes.annotate("", root + reach * direction, root, arrowprops={"arrowstyle": "->", "color": FAINT}, zorder=1)
        axes.annotate(name, root + 1.25 * reach * direction, ha="center", va="center", color=FAINT, size=9)
    scale = 10.0 ** np.floor(np.log10(0.4 * (high - low)[0]))
    start, end = ([high[0] - 0.5 * reach - length, low[1] + 0.5 * reach] for length in (scale, 0.0))
    axes.plot(*np.transpose([start, end]), color=FAINT, linewidth=2.0, solid_capstyle="butt", zorder=1)
    axes.annotate(f"{scale:g} m", start, (0, 4), textcoords="offset points", color=FAINT, size=9)


def _draw_clock(axes, times):
    digits = max(2, 2 - int(np.floor(np.log10(np.max(np.abs(times)) or 1.0))))
    clock = axes.set_title(" ", family="monospace", size=12)  # the layout leaves room for a title
    return Actor(clock, lambda index: clock.set_text(f"t = {times[index]:.{digits}f} s"))


def _draw_ground(axes, scenery, unit):
    """Draw ground under its hinges, and the guides fixed to it."""
    for joint in scenery.mechanism.joints:
        for frame in (joint.parent, joint.child):
            if frame.body == GROUND_NAME and is_hinge(joint):
                _draw_pivot(axes, scenery.seen(GROUND_NAME, frame.offset)[0], SYMBOL_HEIGHT * unit)
            elif frame.body == GROUND_NAME and is_slide(joint):
                _draw_guide(axes, scenery, joint, SYMBOL_HEIGHT * unit)


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


def _draw_guide(axes, scenery, joint, size):
    """Draw the guide of a slide on ground below its box, as far as the slide goes."""
    way, direction = _slide_way(scenery, joint)
    if direction is None:
        return
    direction = direction[0]
    along = (way - way[0]) @ direction
    below = size * np.array([direction[1], -direction[0]])
    start, end = (way[0] + below + reach * direction for reach in (along.min() - 1.5 * size, along.max() + 1.5 * size))
    _draw_hatching(axes, start, end, size)


def _colour(mechanism, body):
    return body_colour(mechanism.topology.bodies.index(body))


def _draw_points(axes, scenery):
    """Draw the path of each named point; its name moves beside it."""
    actors = []
    for name, positions in scenery.points.items():
        way = scenery.camera.seen(positions)
        curve = scenery.camera.seen(scenery.curves[name])
        axes.plot(*curve.T, color=FAINT, linewidth=1.0, linestyle=":", zorder=1)
        backing = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0}
        label = axes.annotate(name, way[0], (0, 13), textcoords="offset points", ha="center", color=INK, bbox=backing)
        actors.append(Actor(label, lambda index, label=label, way=way: setattr(label, "xy", way[index])))
    return actors


def _draw_bodies(axes, scenery):
    """Draw each body as the hull of its marked points with a thick round edge, a concentrated mass as a disc."""
    actors = []
    sections = {section for beam in scenery.mechanism.beams for section in beam.sections}
    bodies = [body for body in scenery.mechanism.bodies if body.name not in sections]
    for body in sorted(bodies, key=lambda body: scenery.depth(body.name)):
        colour, outline = _colour(scenery.mechanism, body.name), scenery.outlines[body.name]
        if len(outline) > 1:
            corners = np.stack([scenery.seen(body.name, mark) for mark in outline], axis=1)
            style = {"color": colour, "linewidth": 8.0, "joinstyle": "round", "capstyle": "round"}
            actors.append(_draw_polygon(axes, list(map(_hull, corners)), style))
        if is_concentrated(scenery.mechanism, body):
            actors.append(_draw_disc(axes, scenery.seen(body.name, body.center_of_mass), 15, colour, INK))
    return actors


def _draw_spans(axes, scenery, unit):
    """Draw beams, ropes, massless rods, springs and dampers."""
    styles = {"beam": {"linewidth": 6.0}, "rod": {"linewidth": 2.2}, "spring": {"linewidth": 1.2}}
    actors = []
    for index, span in enumerate(spans(scenery.mechanism)):
        way = scenery.camera.seen(np.stack([scenery.placed(point) for point in span.points], axis=1))
        colour = body_colour(index) if span.kind == "beam" else INK
        style = {"color": colour, "linewidth": 1.5, "solid_capstyle": "round", "solid_joinstyle": "round"}
        style |= styles.get(span.kind, {})
        if span.kind == "spring":
            way = _between(way, *_ZIGZAG, unit)
        if span.kind == "damper":
            actors.append(_draw_line(axes, _between(way, *_CYLINDER, unit), style))
        actors.append(_draw_line(axes, way, style))
    return actors


# Symbols along a line: places along it, as parts of its length, and beside it, in units of a symbol.
_ZIGZAG = (
    np.array([0.0, *np.linspace(0.15, 0.85, 15), 1.0]),
    0.9 * np.array([0.0, 0.0, *np.resize([1.0, -1.0], 13), 0.0, 0.0]),
)
_CYLINDER = np.array([0.3, 0.3, 0.6, 0.6, 0.3, 0.3]), 0.5 * np.array([0.0, 1.0, 1.0, -1.0, -1.0, 0.0])


def _between(ends, along, aside, unit):
    """A symbol from the first to the second end, (n_f, n, 2)."""
    first, last = ends[:, :1], ends[:, 1:]
    direction = last - first
    length = np.maximum(np.linalg.norm(direction, axis=-1, keepdims=True), NEGLIGIBLE)
    across = np.stack([-direction[..., 1], direction[..., 0]], axis=-1) / length
    return first + along[:, None] * direction + unit * aside[:, None] * across


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


def _slide_way(scenery, joint):
    """Path in the picture of a slide's moving frame, and its direction; None where that is seen from its end."""
    parent, moving = joint.parent, moving_frame(joint)
    axis = joint.frames()[0][:, 0]
    direction = scenery.seen(parent.body, np.asarray(parent.offset) + axis) - scenery.seen(parent.body, parent.offset)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return scenery.seen(moving.body, moving.offset), direction / length if np.all(length > NEGLIGIBLE) else None


def _draw_slides(axes, scenery, unit):
    """Draw a box on each slide, in its direction, smaller where bodies slide in each other."""
    actors = []
    for joint in filter(is_slide, scenery.mechanism.joints):
        grounded = GROUND_NAME in (joint.parent.body, joint.child.body)
        height = SYMBOL_HEIGHT * unit * (1.0 if grounded else 0.5)
        way, direction = _slide_way(scenery, joint)
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
