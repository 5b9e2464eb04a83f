"""A model of MuJoCo in the making: elements of text, and which of them belong to a body, a speed or a point."""

from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from linkax.machines.draft import Pose
from linkax.machines.mjcf.equalities import MOST_COEFFICIENTS
from linkax.machines.poses import pose, to_quaternion
from linkax.machines.write_mjcf.pieces import pose_of
from linkax.model.bodies import Frame
from linkax.model.mechanism import Mechanism
from linkax.model.terms import Combination, Term
from linkax.model.topology import GROUND_INDEX

Element = ElementTree.Element


class Model:
    """A model that gets its elements.

    - `root`: of the text.
    - `bodies`: the element of each body, and its pose where coordinates are zero, `drawn`, by index, the ground's too.
    - `along`: the joint of MuJoCo of each speed, by (joint, index).
    """

    def __init__(self, mechanism: Mechanism, gravity: Float[np.ndarray, "3"]) -> None:
        self.mechanism, self.topology = mechanism, mechanism.topology
        self.root = Element("mujoco")
        add(self.root, "compiler", angle="radian")
        add(add(self.root, "option", gravity=words(gravity)), "flag", contact="disable")
        self.bodies = {GROUND_INDEX: add(self.root, "worldbody")}
        self.drawn: dict[int, Pose] = {GROUND_INDEX: np.eye(4)}
        self.along = dict[tuple[str, int], Element]()

    def section(self, tag: str) -> Element:
        """The only child of the root with that tag."""
        found = self.root.find(tag)
        return add(self.root, tag) if found is None else found

    def equality(self, tag: str, name: str, **attributes: str) -> None:
        """Add an equality."""
        add(self.section("equality"), tag, name=name, **attributes)

    def site(self, name: str, body: int, place: Pose) -> str:
        """Add a point with axes on a body, and return its name."""
        add(self.bodies[body], "site", name=name, **at(place))
        return name

    def site_at(self, name: str, frame: Frame, turned: bool = False) -> str:
        """Add a site at a frame, with its axes where they count, and return its name."""
        place = pose_of(frame) if turned else pose(np.asarray(frame.offset))
        return self.site(name, self.topology.body_index(frame.body), place)

    def spatial(self, name: str, sites: list[str], **attributes: str) -> str:
        """Add a tendon through sites, and return its name."""
        tendon = add(self.section("tendon"), "spatial", name=name, **attributes)
        for site in sites:
            add(tendon, "site", site=site)
        return name

    def fixed(self, element: Any, name: str, terms: Mapping[Term, float]) -> str:
        """Add a tendon that is Σ factor × coordinate, for an element of linkax, and return its name."""
        tendon = add(self.section("tendon"), "fixed", name=name)
        for term, factor in terms.items():
            add(tendon, "joint", joint=self.joint(element, term).get("name", ""), coef=words(factor))
        return name

    def joint(self, element: Any, term: Term) -> Element:
        """The joint of MuJoCo of a term, for an element of linkax.

        **Raises:** `ValueError` for a joint that is cut.
        """
        found = self.along.get((term.joint, term.index or 0))
        if found is None:
            cut = f"joint {term.joint!r} is cut, and MuJoCo has no coordinate of it"
            raise refused(element, f"{cut}; cut another joint of its loop by cut=True")
        return found


def refused(element: Any, why: str) -> ValueError:
    """Make an error about an element of linkax that MuJoCo does not have."""
    kind = type(element).__name__
    what = getattr(element, "display_name", f"joint {element.name!r}")
    return ValueError(f"{what}: {why}; or leave it out by ignore=[{kind!r}], and the motion is another one")


def add(parent: Element, tag: str, **attributes: str) -> Element:
    """Add a child."""
    return ElementTree.SubElement(parent, tag, attributes)


def words(numbers: Any) -> str:
    """Numbers with all digits."""
    return " ".join(repr(float(number)) for number in np.ravel(np.asarray(numbers, dtype=float) + 0.0))


def at(place: Pose) -> dict[str, str]:
    """A pose as attributes."""
    turn = {} if np.array_equal(place[:3, :3], np.eye(3)) else {"quat": words(to_quaternion(place[:3, :3]))}
    return {"pos": words(place[:3, 3])} | turn


def polynomial(*coefficients: Any) -> str:
    """The coefficients of a polynomial of MuJoCo, from the constant on, filled with zeros."""
    return words(np.pad(np.array(coefficients, dtype=float), (0, MOST_COEFFICIENTS - len(coefficients))))


def terms_of(combination: Combination) -> dict[Term, float]:
    """Terms with factors that are not zero."""
    pairs = zip(combination.terms, np.asarray(combination.factors), strict=True)
    return {term: float(factor) for term, factor in pairs if factor}
