"""A figure that a notebook shows."""

import io

import matplotlib.figure


class Figure(matplotlib.figure.Figure):
    """A figure that is shown as the value of a notebook's cell, also where nothing has used pyplot."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format="png")
        return stream.getvalue()
