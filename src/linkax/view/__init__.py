"""Show a motion in three dimensions: in a browser, in a notebook, in programs that play USD."""

from linkax.view.page import View as View
from linkax.view.page import view as view
from linkax.view.write_usd import to_usd as to_usd
