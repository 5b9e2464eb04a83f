"""What is said where a function or a force of a user's own is wrong: the name at fault, and the remedy that helps."""

import math
import threading

import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

ARM = lx.rod("arm", 2.0, 1.0)
TIP = ARM.at("tip", [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
TRACES = "JAX traces it"
WRONG = {
    "a joint that is not there": (lambda t, motion: motion.joint("nip"), "unknown joint 'nip'; known: 'pin'"),
    "its speed": (lambda t, motion: motion.joint_speed("nip"), "unknown joint 'nip'; known: 'pin'"),
    "a body that is not there": (lambda t, motion: motion.orientation("leg")[0, 0], "unknown body 'leg'; known: 'arm'"),
    "no point": (lambda t, motion: motion.point_position("arm")[0], "point is 'arm'; give a body, body.at"),
    "an attribute that is not there": (lambda t, motion: motion.jont("pin"), "known: 'joint'"),
    "one argument": (lambda t: 1.0, "it must take (t, motion)"),
    "an index too many": (lambda t, motion: motion.joint("pin")[3], "IndexError"),
    "Python's sine": (lambda t, motion: math.sin(motion.joint("pin")), TRACES),
    "NumPy's sine": (lambda t, motion: np.sin(motion.joint("pin")), TRACES),
    "an if": (lambda t, motion: 1.0 if motion.joint("pin") > 0.0 else 0.0, TRACES),
}


class Without(lx.AbstractForce):
    """A force whose load is one sided, and does not take the side."""

    def switch(self, t, motion):
        return motion.joint("pin")

    def load(self, t, motion):
        return motion.point_load(ARM, jnp.zeros(3))


class Misspelt(lx.AbstractForce):
    def load(self, t, motion):
        return motion.point_load(ARM, motion.joint("nip") * jnp.ones(3))


def under(force, angle=0.3, speed=2.0):
    mechanism = lx.Mechanism([ARM], [lx.Revolute("pin", lx.GROUND, ARM, "z")], [force])
    return lx.Solution.of_state(mechanism, lx.State(jnp.array([angle]), jnp.array([speed])))


@pytest.mark.parametrize("case", WRONG)
def test_remedies_are_those_of_the_cause(case):
    function, told = WRONG[case]
    with pytest.raises(ValueError, match="JointTorque on 'pin': torque") as caught:
        under(lx.JointTorque("pin", function)).power()
    assert told in str(caught.value)
    assert (TRACES in str(caught.value)) == (told is TRACES)


@pytest.mark.parametrize(
    ("kind", "told"),
    [(Without, "Without: its load .* it must take \\(t, motion, on\\)"), (Misspelt, "Misspelt: .* known: 'pin'")],
)
def test_a_force_of_ones_own_is_named(kind, told):
    with pytest.raises(ValueError, match=told):
        under(kind()).power()


def test_a_law_that_reads_what_cannot_be_compared_is_named():
    lock = threading.Lock()
    told = "'hinge': torque .*: its function reads lock, a _thread.lock, which cannot.*let it read numbers"
    with pytest.raises(ValueError, match=told):
        lx.JointTorque("hinge", lambda t, motion: 1.0 if lock else 0.0)


def test_places_and_axes_in_ground_axes():
    def seen(t, motion):
        place, turned, axes = motion.point_position(TIP), motion.orientation("arm"), motion.orientation(TIP)
        return jnp.concatenate([place, turned[:, 0], axes[:, 0], motion.point_velocity(TIP) / 4.0])

    def check(t, motion):
        cosine, sine = np.cos(0.3), np.sin(0.3)
        tip, along, across = 2.0 * np.array([cosine, sine, 0.0]), [cosine, sine, 0.0], [-sine, cosine, 0.0]
        return jnp.max(jnp.abs(seen(t, motion) - np.concatenate([tip, along, across, across])))

    load = under(lx.JointTorque("pin", check)).power()
    np.testing.assert_allclose(load.forces, 0.0, atol=1e-15)
