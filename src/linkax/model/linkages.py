"""Draw planar linkages by their pins."""

from collections.abc import Iterable, Mapping

import jax.numpy as jnp

from linkax.model.bodies import GROUND, RigidBody
from linkax.model.joints.revolute import Revolute
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number, Vector, number
from linkax.model.rods import rod_between


def linkage(
    pins: Mapping[str, Vector], bars: Mapping[str, Iterable[str]], fixed: Iterable[str], mass: Number = 1.0
) -> Mechanism:
    """Make a planar linkage of bars between pins, as drawn in the x-y plane.

    ```python
    pins = {"O": [0.0, 0.0], "A": [0.0, 0.4], "B": [1.0, 0.9], "C": [1.0, 0.0], "P": [0.4, 1.0]}
    four_bar = lx.linkage(pins, {"crank": "OA", "coupler": "ABP", "rocker": "CB"}, fixed="OC")
    state = lx.State.as_drawn(four_bar)
    ```

    Loops are closed as drawn, whatever the places, which therefore are the parameters to synthesise linkages by.

    **Arguments:**

    - `pins`: {name: [x, y]} [m], as drawn.
    - `bars`: {name: its pins}, two or more: a rod from the first to the second, that carries the others. Each is a
      frame of the body, parallel to the world's as drawn. A pin of one bar alone is a point on it.
    - `fixed`: pins on the ground.
    - `mass`: of each bar, as that of a thin rod between its first two pins [kg].

    **Returns:** a `Mechanism`. A pin between two bodies is a `Revolute` joint of its name; where k meet, k − 1 joints
    called pin_bar lead from the first, or from the ground, to each other bar.

    **Raises:** `ValueError` for unknown pins, bars of fewer than two, and places that are no two numbers.
    """
    at = {pin: number(place, (2,), f"pin {pin!r}: place [m]") for pin, place in pins.items()}
    at = {pin: jnp.array([place[0], place[1], 0.0]) for pin, place in at.items()}
    held, corners = list(fixed), {bar: list(names) for bar, names in bars.items()}
    for what, names in [*((f"bar {bar!r}", names) for bar, names in corners.items()), ("fixed", held)]:
        if unknown := [name for name in names if name not in at]:
            raise ValueError(f"{what} has pin {unknown[0]!r}; known: {', '.join(map(repr, at))}")
    bodies = {}
    for bar, names in corners.items():
        if len(names) < 2:
            raise ValueError(f"bar {bar!r} has pins {names!r}; give two or more")
        rod = rod_between(bar, at[names[0]], at[names[1]], mass)
        frames = {name: at[name] - at[names[0]] for name in names}
        bodies[bar] = RigidBody(bar, mass, rod.center_of_mass, rod.inertia, frames).placed(at[names[0]])
    joints = []
    for pin in at:
        ends = [(bar, bodies[bar].at(pin)) for bar, names in corners.items() if pin in names]
        ends = [("ground", GROUND.at(at[pin])), *ends] if pin in held else ends
        for bar, end in ends[1:]:
            joints.append(Revolute(pin if len(ends) == 2 else f"{pin}_{bar}", ends[0][1], end, axis="z"))
    return Mechanism([*bodies.values()], joints)
