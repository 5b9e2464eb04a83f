"""Plot the paths of points, such as coupler curves."""

import textwrap

from matplotlib.text import Text

from linkax.plot.drawing import draw
from linkax.plot.figure import Figure
from linkax.scenery.colours import body_colour
from linkax.scenery.scenery import Points, scenery_of
from linkax.simulation.read.kinematics import Kinematics

PALE = 0.3  # opacity of the mechanism behind the paths
DOTS_PER_INCH = 100
LONGEST = 60  # characters of names in the title


def path(solution: Kinematics, points: Points) -> Figure:
    """Plot the paths of points in space, such as coupler curves, over the mechanism at the first saved time.

    ```python
    lx.plot.path(solution, {"P": ("coupler", [0.4, 0.25, 0.0]), "pin": ("coupler", "tip")})
    ```

    Lengths [m] are to scale. The picture is in the plane of the motion; of a spatial motion it is from a corner, as
    that of `linkax.plot.animate`.

    **Arguments:** `points`: {name: (body, at)}, see `Solution.position`.

    **Raises:** `ValueError` for no points, for points of another form, an unknown body, and the solution of a batch.
    """
    scenery = scenery_of(solution, points)
    if not scenery.curves:
        raise ValueError(f"points is {points!r}; give at least one, {{name: (body, at)}}")
    figure, axes, actors = draw(scenery, DOTS_PER_INCH)
    for actor in actors:
        actor.move(0)
        if not isinstance(actor.artist, Text):
            actor.artist.set_alpha(PALE)
    for index, (name, curve) in enumerate(scenery.curves.items()):
        seen, colour = scenery.camera.seen(curve), body_colour(index)
        axes.plot(*seen.T, color=colour, linewidth=1.8, label=name, zorder=5)
        axes.plot(*seen[0], "o", color=colour, markersize=5, zorder=5)
    names = textwrap.shorten(", ".join(points), LONGEST, placeholder=" …")
    axes.set_title(f"Path of {names}", family="sans-serif")  # not the clock's
    return figure
