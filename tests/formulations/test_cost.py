"""A scene pays only for what it contains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import mechanism_of
from mechanisms import crank_slider, four_bar

import linkax as lx
from linkax.equations import constraint_rows, coordinates, joint_motions, loops
from linkax.equations.coordinates import neutral
from linkax.equations.structure import structure_of
from linkax.equations.system import system_of
from linkax.model.constraints import ropes


class PinInPlane(lx.Revolute):
    """A hinge of a planar mechanism, with the two rows that matter there picked by hand."""

    locked_rotations = ()
    locked_translations = (1, 2)


def closed_by(kind):
    """A four-bar with a joint of this kind in place of the pin that closes it."""
    drawn = four_bar(1.0, 1.0, 1.0, 1.2, cut="rocker_pin")
    again = lambda pin: kind(pin.name, pin.parent, pin.child, "z", cut=True)
    return lx.Mechanism(drawn.bodies, [again(joint) if joint.cut else joint for joint in drawn.joints], drawn.forces)


def compiled(mechanism):
    """The right-hand side, and how many operations it has."""
    method = lx.TangentSpace().prepared(float, jnp.array([mechanism.topology.num_rows]))

    @jax.jit
    def acceleration(q, v):
        return method.derivative(system_of(mechanism, float), jnp.zeros(()), q, v, True)[1]

    q, v = jnp.array([1.0, 1.2, -1.1]), jnp.array([1.0, 0.5, -0.3])
    program = acceleration.lower(q, v).compile()
    return program(q, v), program.as_text().count(" = ")


def test_spatial_joints_in_a_plane_cost_what_rows_picked_by_hand_cost():
    (spatial, operations), (planar, by_hand) = compiled(closed_by(lx.Revolute)), compiled(closed_by(PinInPlane))
    np.testing.assert_allclose(spatial, planar, rtol=1e-12)
    assert operations <= 1.3 * by_hand
    # With every row the program is longer: the count sees what it is meant to see.
    any_axis = lambda *arguments, **options: lx.Revolute(*arguments[:-1], jnp.array([0.0, 0.0, 1.0]), **options)
    assert closed_by(any_axis).topology.num_rows == 5
    assert compiled(closed_by(any_axis))[1] > by_hand


def traced(mechanism):
    method, system = lx.TangentSpace().prepared(float), system_of(mechanism, float)
    q, v = neutral(mechanism.topology, float), jnp.zeros(mechanism.topology.num_speeds)

    def step(t, q, v):
        return method.derivative(system, t, q, v, True), method.correct(system, t, q, v)

    return jax.make_jaxpr(step)(jnp.zeros(()), q, v)


class NotHereError(Exception):
    pass


def test_special_elements_are_traced_where_they_are(monkeypatch):
    def refuse(*arguments):
        raise NotHereError

    special = (coordinates, "multiply"), (constraint_rows, "_load"), (loops, "combine")
    for module, name in (*special, (joint_motions, "_bent"), (ropes, "_spans")):
        monkeypatch.setattr(module, name, refuse)
    bar, hinge = lx.rod("bar", 1.0, 1.0), lx.Revolute("hinge", lx.GROUND, lx.rod("bar", 1.0, 1.0), "z")
    traced(closed_by(lx.Revolute))
    beam = lx.Beam("beam", 1.0, lx.Section(1.0, 1.0), elements=1, bends="z", torsion=False, stretch=False)
    for joints, constraints in (
        ([hinge, lx.Fixed("weld", bar, beam)], []),
        ([hinge], [lx.Rope("rope", [lx.GROUND, bar.at("tip"), lx.GROUND.at([1.0, 0.0, 0.0])], 2.0)]),
        ([lx.Spherical("ball", lx.GROUND, bar), lx.Revolute("second", lx.GROUND, bar, "z", cut=True)], []),
        ([hinge], [lx.Drive("motor", "hinge", jnp.sin)]),
        ([hinge], [lx.Distance("rope", lx.GROUND.at([1.0, 0.0, 0.0]), bar.at("tip"), 1.0)]),
    ):
        bodies = [bar, beam] if "weld" in [joint.name for joint in joints] else [bar]
        mechanism = lx.Mechanism(bodies, joints, constraints=constraints)
        with pytest.raises(NotHereError):
            traced(mechanism)


def test_mechanisms_that_share_only_ground_are_islands():
    slider, bars = crank_slider(), mechanism_of("n-four-bar", changes={"N": 1})
    bodies, joints = [*slider.bodies, *bars.bodies], [*slider.joints, *bars.joints]
    sizes = lambda mechanism: [(len(rows), len(columns)) for rows, columns in structure_of(mechanism.topology).islands]
    gears = lx.Coupling("gears", {"bearing": 1.0, "pivot_0": 1.0})
    assert sizes(lx.Mechanism(bodies, joints)) == [(2, 3), (2, 3)]
    assert sizes(lx.Mechanism(bodies, joints, constraints=[gears])) == [(5, 6)]
