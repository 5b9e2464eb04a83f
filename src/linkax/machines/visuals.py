"""Read what bodies are drawn as, from the elements that SDF and URDF share: <visual> and the <geometry> in it."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from linkax.machines.draft import Draft, Pose
from linkax.machines.xml import MachineFileError, Node, Where, below, read_numbers

SIZES = {
    "box": {"size": 3}, "sphere": {"radius": 1}, "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1}, "ellipsoid": {"radii": 3}, "mesh": {"scale": 3},
}  # fmt: skip


def read_visual(draft: Draft, body: str, node: Node, at: Pose, colour: Any) -> None:
    """Keep the shape in a <visual>, from its pose on the body and its colour or None.

    **Raises:** `ValueError` for a shape that linkax does not draw, and a mesh that is not there.
    """
    node.moves_nothing()
    shape = next((child for child in node.child("geometry") if child.tag in SIZES), None)
    if shape is None:
        raise ValueError(f"its geometry is none of {', '.join(SIZES)}")
    if shape.find("submesh") is not None:
        raise ValueError("a part of a mesh is not drawn")
    size = [entry for name, count in SIZES[shape.tag].items() for entry in _numbers(shape, name, count)]
    mesh = None
    if shape.tag == "mesh":
        mesh = find_mesh(draft, shape.attributes.get("filename") or shape.content("uri") or "", shape.where)
    draft.shape(body, shape.tag, size, at, mesh, colour)


def _numbers(node: Node, name: str, count: int) -> np.ndarray:
    """Numbers in an attribute, as URDF has them, or in a child, as SDF does."""
    child = node.find(name)
    if child is not None:
        return read_numbers(child.text, count, child.where)
    return node.numbers(name, count, [1.0] * count if name == "scale" else None)


def find_mesh(draft: Draft, address: str, where: Where) -> Path:
    """The path of a mesh: relative to the folder of the file, or model://... and package://... below an allowed folder.

    The first word of such an address is a folder in an allowed one, or is it, or one that it lies in.

    **Raises:** `ValueError` where none is there.
    """
    scheme, _, name = address.strip().rpartition("://")
    roots = [folder.absolute() for folder in draft.folders]
    folders: Sequence[Path] = roots[:1]
    if scheme in ("model", "package"):
        package = name.partition("/")[0]
        named = [way.parent for root in roots for way in (root, *root.parents) if way.name == package]
        folders = [*roots, *named]
    elif scheme not in ("", "file"):
        raise ValueError(f"mesh {address[:200]!r} is no file")
    for folder in folders if name else ():
        with suppress(MachineFileError, OSError):
            path = below(folder, name, roots, where.error)
            if path.is_file():
                return path
    raise ValueError(f"mesh file {address[:200]!r} is not there; folders=[...] may have it")
