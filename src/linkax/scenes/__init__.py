"""Ready-made scenes: the mechanisms of the paper, benchmark problems with known answers, and machines."""

from linkax.scenes.bricard import BRICARD
from linkax.scenes.crank_slider import CRANK_SLIDER
from linkax.scenes.delta import DELTA
from linkax.scenes.excavator import EXCAVATOR
from linkax.scenes.five_bar import FIVE_BAR
from linkax.scenes.hoberman import HOBERMAN
from linkax.scenes.n_four_bar import N_FOUR_BAR
from linkax.scenes.pendulum import PENDULUM
from linkax.scenes.planar_four_bar import PLANAR_FOUR_BAR
from linkax.scenes.rigid_crane import RIGID_CRANE
from linkax.scenes.scene import Scene
from linkax.scenes.six_bars import STEPHENSON_SIX_BAR, WATT_SIX_BAR
from linkax.scenes.spatial_four_link import SPATIAL_FOUR_LINK
from linkax.scenes.strandbeest import STRANDBEEST
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
    DELTA,
    FIVE_BAR,
    EXCAVATOR,
    WATT_SIX_BAR,
    STEPHENSON_SIX_BAR,
    STRANDBEEST,
    HOBERMAN,
)
SCENES: dict[str, Scene] = {scene.name: scene for scene in _ALL}


def scene(name: str) -> Scene:
    """Return the scene of that name.

    **Raises:** `ValueError` for an unknown name, with the known ones.
    """
    if name not in SCENES:
        raise ValueError(f"unknown scene {name!r}; known: {', '.join(SCENES)}")
    return SCENES[name]
