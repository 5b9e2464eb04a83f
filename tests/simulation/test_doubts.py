"""What `assemble` says of odd answers, and that it says nothing of others."""

import re
import warnings

import numpy as np
import pytest
from mechanisms import coupler_between_balls, pendulum

import linkax as lx


def test_angles_that_may_be_degrees():
    with pytest.warns(lx.AssemblyWarning, match=r"position of joint 'hinge' is 90 rad.*deg2rad\(90\)"):
        lx.assemble(pendulum(), {"hinge": 90.0})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lx.assemble(pendulum(), {"hinge": -9.4})
        lx.assemble(pendulum(forces=[lx.JointSpring("hinge", 2.0)]), {"hinge": 90.0})  # which counts turns


LAW = lx.ContactLaw(1e3)
UNCOUNTED = {
    "a stop": [lx.JointLimit("hinge", LAW, lower=-100.0, upper=100.0)],
    "friction": [lx.JointFriction("hinge", 0.1, 0.01), lx.JointDamper("hinge", 0.1), lx.JointTorque("hinge", 1.0)],
}


@pytest.mark.parametrize("forces", UNCOUNTED.values(), ids=UNCOUNTED)
def test_forces_that_count_no_turns_hide_no_degrees(forces):
    with pytest.warns(lx.AssemblyWarning, match=r"position of joint 'hinge' is 45 rad.*deg2rad\(45\)"):
        lx.assemble(pendulum(forces=forces), {"hinge": 45.0})


def test_a_law_may_count_turns():
    law = lambda t, motion: -2.0 * motion.joint("hinge")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lx.assemble(pendulum(forces=[lx.JointTorque("hinge", law)]), {"hinge": 45.0})


@pytest.mark.parametrize(
    ("at", "told"), [(1.2, "ends its range at upper = 1 rad"), (-2.0, "lower = -0.5 rad"), (1.1, "")]
)
def test_starts_beyond_a_stop(at, told):
    """A little beyond it a motion may rest."""
    limited = pendulum(forces=[lx.JointLimit("hinge", LAW, lower=-0.5, upper=1.0)])
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        lx.assemble(limited, {"hinge": at})
    assert len(found) == bool(told)
    assert all(f"'hinge' is at {at:g} rad" in str(each.message) and told in str(each.message) for each in found)


def test_struts_of_lengths_of_both_signs():
    """Two struts between a lever and a plate, with nothing to tell which way they point."""
    lever, plate = lx.rod("lever", 1.0, 1.0), lx.box("plate", [1.0, 0.1, 0.1], 1.0)
    tubes = [lx.point_mass(f"tube_{i}", 0.1) for i in range(2)]
    joints = [
        lx.Revolute("pin", lx.GROUND, lever.at("base"), axis="z"),
        lx.Prismatic("slide", lever.at("tip"), tubes[0], axis="x"),
        lx.Prismatic("other", lever.at("base"), tubes[1], axis="x"),
        lx.Fixed("weld", lx.GROUND.at([0.4, 0.0, 0.0]), plate),
        lx.Spherical("near", tubes[0], plate, cut=True),
        lx.Spherical("far", tubes[1], plate, cut=True),
    ]
    mechanism = lx.Mechanism([lever, plate, *tubes], joints)
    with pytest.warns(lx.AssemblyWarning, match=r"below zero, 'slide' \(-0\.6 m\)"):
        lx.assemble(mechanism)


@pytest.mark.parametrize("off", [0.0, 0.005, 0.05])
def test_rods_that_are_drawn_apart(off):
    """By more than a hundredth of the size, of joints that join points, where no guess says where they are."""
    crank = lx.rod_between("crank", [0.0, 0.0, 0.0], [0.0, 0.4, 0.0], 1.0)
    coupler = lx.rod_between("coupler", [0.0, 0.4, 0.0], [1.0, 0.9, 0.0], 1.0)
    rocker = lx.rod_between("rocker", [1.0, 0.0, 0.0], [1.0, 0.9 + off, 0.0], 1.0)
    block = lx.point_mass("block", 1.0).placed([3.0, 0.0, 0.0])
    joints = [
        lx.Revolute("motor", lx.GROUND, crank.at("base"), axis="z"),
        lx.Revolute("crank_pin", crank.at("tip"), coupler.at("base"), axis="z"),
        lx.Revolute("rocker_pin", coupler.at("tip"), rocker.at("tip"), axis="z"),
        lx.Revolute("bearing", lx.GROUND.at([1.0, 0.0, 0.0]), rocker.at("base"), axis="z"),
        lx.Prismatic("slide", lx.GROUND, block, axis="x"),  # whose length may be any
    ]
    mechanism = lx.Mechanism([crank, coupler, rocker, block], joints)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        state = lx.assemble(mechanism, {"motor": 0.0})
        lx.assemble(mechanism, {"motor": 0.0}, guess={"rocker.tip": [1.0, 0.9, 0.0]})
    np.testing.assert_allclose(state.q[0], 0.0, atol=1e-12)
    assert len(told) == (off > 0.01)
    if told:
        assert re.search(r"'rocker_pin' joins points that are drawn 0\.05 m apart, .*draw them", str(told[0].message))


@pytest.mark.slow
def test_a_spin_that_nothing_decides():
    """Of a coupler between two balls: asked for, it is as asked."""
    mechanism = coupler_between_balls()
    told = "nothing decides how fast body 'coupler' spins about the line between 'near' and 'far'"
    with pytest.warns(lx.AssemblyWarning, match=told) as warned:
        found = lx.assemble(mechanism, {"hinge": 1.0}, {"hinge": 2.0})
    (advice,) = re.findall(r"speeds=(\{.*\})", str(warned[0].message))
    turning = lx.Solution.of_state(mechanism, found).angular_velocity("coupler")[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lx.assemble(mechanism, {"hinge": 1.0}, {"hinge": 2.0} | eval(advice))
        again = lx.assemble(mechanism, {"hinge": 1.0}, {"coupler": lx.Velocity(angular=turning)})
    np.testing.assert_allclose(again.v, found.v, atol=1e-9)
