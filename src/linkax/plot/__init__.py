"""Plot a motion against time, animate it, and compare formulations: `lx.plot.energy(solution)`."""

from linkax.plot.animation import Animation as Animation
from linkax.plot.animation import animate as animate
from linkax.plot.comparison import comparison as comparison
from linkax.plot.histories import energy as energy
from linkax.plot.histories import joint as joint
from linkax.plot.histories import motion as motion
from linkax.plot.histories import reaction as reaction
from linkax.plot.histories import singularity as singularity
from linkax.plot.histories import states as states
from linkax.plot.histories import violations as violations
from linkax.plot.paths import path as path
