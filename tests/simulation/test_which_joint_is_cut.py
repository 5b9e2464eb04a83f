"""Which joint of a loop is cut matters to no element: angles count turns wherever one is read."""

import numpy as np
import pytest
from mechanisms import four_bar

import linkax as lx

LAW = lx.ContactLaw(stiffness=1e3, restitution=0.8, impact_speed=5.0)


class Winding(lx.AbstractForce):
    """A spring of one's own, which says only along which joint it acts."""

    terms = (lx.Term("crank_pin", None),)
    display_name = "winding"

    def load(self, t, motion):
        return motion.joint_load(self.terms[0], -0.1 * motion.joint("crank_pin"))


READS_ANGLES = [
    lx.JointSpring("crank_pin", 0.2, 0.1),
    lx.JointLimit("crank_pin", LAW, lower=-4.0),
    lx.Impact("crank_pin", lower=-4.0, restitution=0.5),
    lx.PIDController("crank_pin", 0.3, proportional=0.1),
    lx.AffineActuator({"crank_pin": 2.0}, bias=[0.0, -0.1, 0.0]),
    lx.JointTorque("crank_pin", lambda t, motion: -0.1 * motion.joint("crank_pin")),
    Winding(),
]
READS_NONE = [
    lx.JointTorque("crank_pin", 0.3),
    lx.JointDamper("crank_pin", 0.3),
    lx.JointFriction("crank_pin", 0.3, 0.1),
]
RELATES = [
    lx.Coupling("gears", {"crank_pin": 1.0, "crank_bearing": 1.0}),
    lx.PolynomialCoupling("curve", "crank_pin", "crank_bearing", [0.0, 0.2, 0.1]),
    lx.Drive("motor", "crank_pin", speed=-6.0),
]


@pytest.mark.parametrize("cut", ["crank_pin", "rocker_pin", None])
def test_joints_whose_angles_are_read_have_coordinates(cut):
    for force in READS_ANGLES:
        assert "crank_pin" in four_bar(cut=cut, forces=[force]).topology.speeds
    for force in READS_NONE:
        assert ("crank_pin" in four_bar(cut=cut, forces=[force]).topology.speeds) == (cut != "crank_pin")
    for constraint in RELATES:
        assert "crank_pin" in four_bar(cut=cut, constraints=[constraint]).topology.speeds
    everywhere = [lx.JointSpring(name, 1.0) for name in four_bar().topology.joints]
    assert {*four_bar().topology.joints} <= {*four_bar(cut=cut, forces=everywhere).topology.speeds}


@pytest.mark.slow
@pytest.mark.parametrize("elements", [{"forces": [*READS_ANGLES[:2], *READS_ANGLES[3:]]}, {"constraints": RELATES[2:]}])
def test_the_motion_is_the_same(elements):
    """Over more than half a turn of the crank pin, where an angle that counts no turns would jump."""

    def end(cut):
        mechanism = four_bar(cut=cut, **elements)
        speeds = {} if "constraints" in elements else {"crank_bearing": 14.0}
        start = lx.assemble(mechanism, {"crank_pin": 0.0}, speeds, guess={"rocker_bearing": 1.0})
        found = lx.simulate(mechanism, start, t1=1.5, accuracy=lx.PRECISE)
        turned = found.joint("crank_pin")
        return np.array([turned[-1] - turned[0], *found.position("coupler")[-1]]), np.ptp(turned)

    (found, turned), (right, _) = end("crank_pin"), end("rocker_pin")
    np.testing.assert_allclose(found, right, atol=1e-7)
    assert turned > np.pi
