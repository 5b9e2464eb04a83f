"""A model that MuJoCo has compiled, with the names and lines that its file gives the elements."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from linkax.machines.draft import Draft, body_name
from linkax.machines.xml import Where
from linkax.model.bodies import GROUND_NAME
from linkax.model.names import free_name

OF_CONSTRAINTS = ("EQUALITY", "FRICTIONLOSS", "LIMIT", "CONTACT")


class Compiled:
    """A model that MuJoCo has compiled, to be read into a draft.

    - `mujoco`, `spec`, `model`: the library, the elements of the file, and the numbers of them by index.
    - `body_names`, `joint_names`: by index, unique. `joint_kinds`: "hinge", "slide", "ball" or "free".
    - `gravity` [m/s²], (3,), zero where it is disabled.
    """

    def __init__(self, mujoco: Any, spec: Any, model: Any, draft: Draft) -> None:
        self.mujoco, self.model, self.draft = mujoco, model, draft
        self.spec, self._found = spec, dict[str, dict[int, Any]]()
        self.gravity = np.array(model.opt.gravity) * self.has("GRAVITY")
        self.body_names = [GROUND_NAME, *map(body_name, self.names("body")[1:])]
        self.joint_kinds = [mujoco.mjtJoint(int(kind)).name.removeprefix("mjJNT_").lower() for kind in model.jnt_type]
        bodies = [self.body_names[body] for body in model.jnt_bodyid]
        stems = [f"{body}.{kind}" for body, kind in zip(bodies, self.joint_kinds, strict=True)]
        self.joint_names = self.names("joint", stems)

    def has(self, what: str) -> bool:
        """Whether a kind of force is not disabled by a <flag>, nor all that MuJoCo computes as constraints."""
        kinds = (what, "CONSTRAINT") if what in OF_CONSTRAINTS else (what,)
        return not any(
            self.model.opt.disableflags & int(getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{kind}")) for kind in kinds
        )

    def elements(self, kind: str) -> dict[int, Any]:
        """The elements of a kind as the file has them, by their index in the model."""
        if kind not in self._found:
            plural = {"body": "bodies", "equality": "equalities", "mesh": "meshes"}.get(kind, f"{kind}s")
            self._found[kind] = {element.id: element for element in getattr(self.spec, plural)}
        return self._found[kind]

    def names(self, kind: str, instead: Sequence[str] | None = None) -> list[str]:
        """Names by index; for what has none the one given instead, with a number where that is taken."""
        given, found = self.elements(kind), list[str]()
        taken = {element.name for element in given.values()}
        for index in range(len(given)):
            stem = kind if instead is None else instead[index]
            found.append(given[index].name or free_name(stem, taken))
            taken.add(found[-1])
        return found

    def where(self, kind: str, index: int) -> Where:
        """The place of an element by its index in the model."""
        element = self.elements(kind)[index]
        return Where(self.draft.path, line_of(element), kind, element.name)


def line_of(element: Any) -> int:
    """The line of an element, 0 where MuJoCo does not know it."""
    words = element.info.split()
    return int(words[1]) if len(words) > 1 and words[1].isdigit() else 0
