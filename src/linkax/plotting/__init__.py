"""Plot a motion: time histories, and an animation."""

from linkax.plotting.animation import animate_mechanism as animate_mechanism
from linkax.plotting.histories import plot_energy as plot_energy
from linkax.plotting.histories import plot_point_motion as plot_point_motion
from linkax.plotting.histories import plot_reaction as plot_reaction
from linkax.plotting.histories import plot_violations as plot_violations
