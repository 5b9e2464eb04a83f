"""The files that an MJCF file names: where they may lie, and what is left of the machine where meshes are not there."""

from collections.abc import Iterator
from typing import Any

from linkax.machines.draft import Draft
from linkax.machines.mjcf.compiled import line_of
from linkax.machines.xml import Node, Where, below, read_xml

FILES = ("mesh", "texture", "hfield", "skin", "flex", "flexcomp", "model", "include")  # elements that name a file
DEEPEST = 20  # files that include each other


def check_files(root: Node, draft: Draft) -> set[str]:
    """Check where the files lie that a file names, and return the names of meshes that are not there."""
    missing: set[str] = set()
    open_ones = [(root, 0)]
    while open_ones:
        node, depth = open_ones.pop()
        compilers = [each for each in _nested(node) if each.tag == "compiler"]
        folders = {name: text for each in compilers for name, text in each.attributes.items() if name.endswith("dir")}
        for each in _nested(node):
            file = each.attributes.get("file", "")
            if each.tag not in FILES or not file:
                continue
            folder = folders.get("texturedir" if each.tag == "texture" else "meshdir", folders.get("assetdir", ""))
            given = file if each.tag in ("include", "model") else f"{folder}/{file}" if folder else file
            path = below(draft.path.parent, given, draft.folders, each.where.error)
            if each.tag in ("include", "model"):
                if depth == DEEPEST:
                    raise each.where.error(f"{DEEPEST} files include each other; take one out")
                open_ones.append((read_xml(path), depth + 1))
            elif not path.is_file():
                missing.add(each.attributes.get("name") or path.stem)
                draft.leave_out(each.where, each.tag, f"file {file!r} is not there", False)
    return missing


def _nested(node: Node) -> Iterator[Node]:
    yield node
    for child in node:
        yield from _nested(child)


def take_out_missing(spec: Any, missing: set[str], draft: Draft) -> None:
    """Take out what is only drawn, and meshes that are not there; of a body whose inertia comes from one, note that."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in list(spec.textures):
        spec.delete(texture)
    for geom in list(spec.geoms):
        if geom.meshname not in missing:
            continue
        body = geom.parent
        if not body.explicitinertial and _moves(body) and geom.mass != 0.0:
            where = Where(draft.path, line_of(geom), "geom", geom.name or geom.meshname)
            draft.leave_out(where, "mesh", "its file is not there, from which body has its inertia")
        spec.delete(geom)
    for mesh in [mesh for mesh in spec.meshes if mesh.name in missing]:
        spec.delete(mesh)


def _moves(body: Any) -> bool:
    """Whether a body, or one that carries it, has a joint."""
    while body is not None:
        if len(body.joints):
            return True
        body = body.parent
    return False
