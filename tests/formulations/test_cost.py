"""A scene pays only for what it contains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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


def four_bar(closing):
    bars = [lx.rod(name, 1.0, 1.0) for name in ("crank", "coupler", "rocker")]
    crank, coupler, rocker = bars
    joints = [
        lx.Revolute("A", lx.GROUND, crank.at("base"), "z"),
        lx.Revolute("B", crank.at("tip"), coupler.at("base"), "z"),
        closing("C", coupler.at("tip"), rocker.at("tip"), "z", cut=True),
        lx.Revolute("D", lx.GROUND.at([1.2, 0.0, 0.0]), rocker.at("base"), "z"),
    ]
    return lx.Mechanism(bars, joints, [lx.Gravity([0.0, -9.81, 0.0])])


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
    (spatial, operations), (planar, by_hand) = compiled(four_bar(lx.Revolute)), compiled(four_bar(PinInPlane))
    np.testing.assert_allclose(spatial, planar, rtol=1e-12)
    assert operations <= 1.3 * by_hand
    # With every row the program is longer: the count sees what it is meant to see.
    any_axis = lambda *arguments, **options: lx.Revolute(*arguments[:-1], jnp.array([0.0, 0.0, 1.0]), **options)
    assert four_bar(any_axis).topology.num_rows == 5
    assert compiled(four_bar(any_axis))[1] > by_hand


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
    traced(four_bar(lx.Revolute))
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
    def slider_crank(number):
        crank, rod = lx.rod(f"crank{number}", 1.0, 1.0), lx.rod(f"rod{number}", 1.3, 1.0)
        slider = lx.point_mass(f"slider{number}", 1.0)
        return [crank, rod, slider], [
            lx.Revolute(f"bearing{number}", lx.GROUND, crank.at("base"), "z"),
            lx.Revolute(f"crank_pin{number}", crank.at("tip"), rod.at("base"), "z"),
            lx.Revolute(f"wrist_pin{number}", rod.at("tip"), slider, "z"),
            lx.Prismatic(f"guide{number}", lx.GROUND, slider, "x"),
        ]

    (bodies, joints), (more_bodies, more_joints) = slider_crank(0), slider_crank(1)
    sizes = lambda mechanism: [(len(rows), len(columns)) for rows, columns in structure_of(mechanism.topology).islands]
    gears = lx.Coupling("gears", {"bearing0": 1.0, "bearing1": 1.0})
    assert sizes(lx.Mechanism(bodies + more_bodies, joints + more_joints)) == [(2, 3), (2, 3)]
    assert sizes(lx.Mechanism(bodies + more_bodies, joints + more_joints, constraints=[gears])) == [(5, 6)]
