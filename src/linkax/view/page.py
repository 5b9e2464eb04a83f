"""Make the page on which a browser shows a motion."""

import base64
import gzip
import html
import json
import os
import sys
import tempfile
import webbrowser
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from linkax.files import written_whole
from linkax.model.numbers import require_type
from linkax.scenery.scenery import Points, reached, scenery_of
from linkax.simulation.read.kinematics import Kinematics
from linkax.simulation.read.solution import Solution
from linkax.view.contents import contents

MOST_NUMBERS = 300_000  # in a page, of poses; of longer runs, fewer of the saved times are shown
HEIGHT = 480  # in a notebook, in pixels


class View:
    """A page with a mechanism in motion, for any browser, without network.

    In a notebook it shows itself as the value of a cell. It plays when it is opened; drag turns it, the wheel zooms,
    space pauses and plays.

    - `html`: the page as text.
    """

    def __init__(self, page: str) -> None:
        self.html = page

    def save(self, path: str | os.PathLike) -> Path:
        """Write the page as one file."""
        with written_whole(Path(path)) as part:
            Path(part).write_text(self.html, encoding="utf-8")
        return Path(path)

    def show(self) -> None:
        """Open the page in the browser; where there is none, tell the path of the page."""
        path = self.save(Path(tempfile.mkdtemp(prefix="linkax-")) / "view.html")
        if not webbrowser.open(path.as_uri()):
            print(f"no browser opens from here; the page is {path}", file=sys.stderr)

    def __repr__(self) -> str:
        return f"View of {len(self.html) / 1e6:.1f} MB: .show() opens it in the browser, .save(path) writes it"

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{HEIGHT}px;border:1px solid #ddd"
        return f'<iframe srcdoc="{html.escape(self.html)}" style="{style}" allowfullscreen></iframe>'


def view(
    solution: Kinematics,
    path: str | os.PathLike | None = None,
    *,
    points: Points | None = None,
    reactions: bool | list[str] = False,
) -> View:
    """Show a motion in three dimensions, see `linkax.Solution.view`."""
    saved = reached(solution)
    bodies = len(saved.mechanism.topology.bodies)
    stride = max(1, -(-7 * bodies * len(saved.ts) // MOST_NUMBERS))
    shown = np.unique([*range(0, len(saved.ts), stride), len(saved.ts) - 1])
    scenery = scenery_of(saved, points or {}, None if stride == 1 else np.asarray(saved.ts)[shown])
    page = View(_page(*contents(scenery, _arrows(saved, reactions, shown))))
    if path is not None:
        page.save(path)
    return page


def _arrows(saved, reactions, shown):
    """{label: where a force acts, and its vectors at the times shown}."""
    if not isinstance(saved, Solution):
        if reactions:
            raise ValueError("a trace has no forces; leave reactions out, or show those of a solution")
        return {}
    arrows = {}
    for name in _asked(saved, reactions):
        force, joint = np.asarray(saved.reaction(name).force)[shown], saved.mechanism.joint(name)
        arrows[f"{name}: force on {joint.child.body}"] = joint.child, np.where(np.isfinite(force), force, 0.0)
    return arrows


def _asked(saved, reactions) -> list[str]:
    """Names of the joints whose reactions are shown."""
    if isinstance(reactions, bool | np.bool_):
        return list(saved.mechanism.topology.joints) if reactions else []
    remedy = 'give True for all joints, or a list of names, ["bearing"]'
    return [saved.mechanism.joint(name).name for name in require_type(reactions, list | tuple, "reactions", remedy)]


def _page(described: dict[str, Any], numbers: bytes, meshes: bytes) -> str:
    folder = files("linkax.view")
    text = lambda name: folder.joinpath(name).read_text(encoding="utf-8")
    filled = {
        "VIEWER": text("viewer.js"),
        "LICENSE": text("three/LICENSE").replace("-->", ""),
        "THREE": _packed(text("three/three.min.js").encode()),
        "CONTENTS": _packed(json.dumps(described, allow_nan=False).encode()),
        "NUMBERS": _packed(numbers),
        "MESHES": _packed(meshes),
    }
    page = text("page.html")
    for name, entry in filled.items():
        page = page.replace(f"%{name}%", entry)
    return page


def _packed(entry: bytes) -> str:
    return base64.b64encode(gzip.compress(entry, mtime=0)).decode()
