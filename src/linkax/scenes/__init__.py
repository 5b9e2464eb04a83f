"""Ready-made scenes: the mechanisms of the paper, and benchmark problems with known answers."""

from linkax.scenes.crank_slider import CRANK_SLIDER
from linkax.scenes.n_four_bar import N_FOUR_BAR
from linkax.scenes.pendulum import PENDULUM
from linkax.scenes.scene import Scene

SCENES: dict[str, Scene] = {scene.name: scene for scene in (PENDULUM, CRANK_SLIDER, N_FOUR_BAR)}


def scene(name: str) -> Scene:
    """The scene of that name.

    **Raises:** `ValueError` naming the known ones.
    """
    if name not in SCENES:
        raise ValueError(f"unknown scene {name!r}; known: {', '.join(SCENES)}")
    return SCENES[name]
