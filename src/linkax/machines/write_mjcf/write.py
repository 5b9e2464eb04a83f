"""Write a mechanism as MJCF: its bodies, loops, couplings and forces, and where its motion starts."""

import os
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from linkax.files import written_whole
from linkax.machines.write_mjcf.bodies import write_bodies
from linkax.machines.write_mjcf.constraints import write_constraint
from linkax.machines.write_mjcf.coordinates import in_mujoco
from linkax.machines.write_mjcf.forces import write_forces
from linkax.machines.write_mjcf.loops import write_cut
from linkax.machines.write_mjcf.model import Model, add, words
from linkax.machines.write_mjcf.pieces import check_tree
from linkax.machines.write_mjcf.shapes import write_shapes
from linkax.model.forces.force import Gravity
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import listed
from linkax.model.shapes import Shape
from linkax.simulation.start.state import State


def to_mjcf(
    mechanism: Mechanism,
    path: str | os.PathLike[str] | None = None,
    *,
    state: State | None = None,
    ignore: Iterable[str] = (),
) -> str:
    """Write a mechanism as MJCF, for MuJoCo and all that reads its format.

    ```python
    text = lx.to_mjcf(mechanism, "four_bar.xml", state=state)
    model = mujoco.MjModel.from_xml_string(text)
    qpos, qvel = lx.mujoco_trajectory(solution)  # in the order of this model
    ```

    Bodies are nested by the spanning tree, and drawn where all its coordinates are zero; `qpos` of hinges and slides
    are linkax's coordinates. A joint that MuJoCo does not have becomes several, named `joint[index]` by the index of
    the speed; a `Screw` becomes a hinge, a slide and an equality. A `Free` joint becomes a freejoint where its parent
    is the ground and nothing acts along it. Frames on bodies become sites.

    Loops are closed by `<equality>`: two connects on the axis of a `Revolute`, a connect for a `Spherical`, a weld for
    a `Fixed` joint, a tendon for a `Distance`. `Coupling` and `PolynomialCoupling` are equalities, too. MuJoCo keeps
    them softly: loops gape by what its `solref` and `solimp` allow.

    Of forces MuJoCo gets `Gravity`, `JointSpring`, `JointDamper`, `JointInertia`, `Spring`, `Damper`, and as actuators
    `JointTorque` and `AffineActuator`, whose constant control is in the bias: MuJoCo's control is added to it. It has
    laws of its own for `JointFriction`, dry friction without a scale, and for `JointLimit`, a stop without a contact
    law.

    Shapes of bodies, `RigidBody(shape=[lx.Shape(...)])`, become geoms without mass, which MuJoCo's viewer shows, and
    contact is off. Meshes are named by the whole path of their file, a binary STL or OBJ; a warning tells of others,
    and of those that are not there.

    Numbers have all digits. Where a body has no mass, or no inertia about an axis, it gets 2e-15 kg or kg m², since
    MuJoCo refuses zero; the smallest moment of a thin or flat body grows by 1e-12 of the largest.

    **Arguments:**

    - `path`: of the file, which is written whole; None for the text alone.
    - `state`: a `linkax.State` for the keyframe "start".
    - `ignore`: elements to leave out, by their name or the name of their class, such as ["Drive"]; the motion then is
      another one. "Shape" leaves out all shapes.

    **Returns:** the text.

    **Raises:** `ValueError` naming the element that MuJoCo does not have: beams, other joints, forces and constraints,
    functions of time; for what acts along a cut joint; for traced numbers and batches.
    """
    ignored = [ignore] if isinstance(ignore, str) else listed(ignore, str, "ignore", 'give names such as ["Drive"]')
    check_tree(mechanism, state)
    model = _model(mechanism, {*ignored})
    model.root.set("model", "mechanism" if path is None else Path(path).stem)
    if state is not None:
        qpos, qvel = (words(entries) for entries in in_mujoco(mechanism, state.q, state.v))
        add(model.section("keyframe"), "key", name="start", qpos=qpos, qvel=qvel)
    ElementTree.indent(model.root)
    text = ElementTree.tostring(model.root, encoding="unicode") + "\n"
    if path is not None:
        try:
            with written_whole(Path(path)) as unfinished:
                unfinished.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ValueError(f"cannot write {str(path)!r}: {error.strerror}; give another path") from error
    return text


def _model(mechanism: Mechanism, ignored: set[str]) -> Model:
    """All elements of a mechanism but those that are ignored, by name or class."""
    ignores = lambda name, element: bool({name, type(element).__name__} & ignored)
    named = zip(mechanism.force_names, mechanism.forces, strict=True)
    forces = [(name, force) for name, force in named if not ignores(name, force)]
    gravities = [np.asarray(force.acceleration) for _, force in forces if isinstance(force, Gravity)]
    model = Model(mechanism, sum(gravities, np.zeros(3)))
    write_bodies(model)
    if Shape.__name__ not in ignored:
        write_shapes(model)
    for joint in mechanism.joints[mechanism.topology.num_bodies :]:
        if not ignores(joint.name, joint):
            write_cut(model, joint)
    for constraint in mechanism.constraints:
        if not ignores(constraint.name, constraint):
            write_constraint(model, constraint)
    write_forces(model, forces)
    return model
