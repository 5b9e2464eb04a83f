"""Ready-made scenes: the mechanisms of the paper, and benchmark problems with known answers."""

from linkax.scenes.bricard import BRICARD
from linkax.scenes.crank_slider import CRANK_SLIDER
from linkax.scenes.n_four_bar import N_FOUR_BAR
from linkax.scenes.pendulum import PENDULUM
from linkax.scenes.planar_four_bar import PLANAR_FOUR_BAR
from linkax.scenes.rigid_crane import RIGID_CRANE
from linkax.scenes.scene import Scene
from linkax.scenes.spatial_four_link import SPATIAL_FOUR_LINK
from linkax.scenes.telescopic_crane import TELESCOPIC_CRANE

_ALL = (
    PENDULUM,
    CRANK_SLIDER,
    N_FOUR_BAR,
    SPATIAL_FOUR_LINK,
    PLANAR_FOUR_BAR,
    BRICARD,
    RIGID_CRANE,
    TELESCOPIC_CRANE,
)
SCENES: dict[str, Scene] = {scene.name: scene for scene in _ALL}


def scene(name: str) -> Scene:
    """Return the scene of that name.

    **Raises:** `ValueError` for an unknown name, with the known ones.
    """
    if name not in SCENES:
        raise ValueError(f"unknown scene {name!r}; known: {', '.join(SCENES)}")
    return SCENES[name]
