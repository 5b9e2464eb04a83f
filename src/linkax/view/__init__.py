"""Show a motion in three dimensions, in a browser or a notebook."""

from linkax.view.page import View as View
from linkax.view.page import view as view
