"""Joint types in motion: quaternions, redundancy, singular configurations, drives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import n_four_bar, reference, turning
from mechanisms import pendulum

import linkax as lx
from linkax.scenes import SCENES


def rhombus(*kinds, copies=1, speed=1.0, gravity=0.0):
    """The spatial four-link with other joints; it turns uniformly, and passes a singular position each half turn."""
    along = np.array([1.0, 0.0, 0.0])
    crank, coupler, rocker = (
        lx.RigidBody(name, 1.0, along / 2, [0.01, 1 / 12, 1 / 12], {"base": 0.0 * along, "tip": along})
        for name in ("crank", "coupler", "rocker")
    )
    ends = [
        (lx.GROUND, crank.at("base")),
        (crank.at("tip"), coupler.at("base")),
        (coupler.at("tip"), rocker.at("tip")),
        (lx.GROUND.at([1.0, 0.0, 0.0]), rocker.at("base")),
    ]
    joints = []
    for name, kind, pair in zip("ABCD", kinds, ends, strict=True):
        options = {} if kind is lx.Spherical else {"axis": "z"}
        options |= {"pitch": 0.2} if kind is lx.Screw else {}
        options |= {"second_axis": "y"} if kind is lx.Universal else {}
        options |= {"cut": True} if name == "C" else {}
        names = [name] + [f"{name}{copy}" for copy in range(1, copies) if name == "C"]
        joints += [kind(each, *pair, **options) for each in names]
    mechanism = lx.Mechanism([crank, coupler, rocker], joints, [lx.Gravity([0.0, -gravity, 0.0])])
    turning = lambda turn: {"A": turn, "B": -turn, "D": turn}
    of_kind = lambda turns: {
        name: [turn] + [0.0] * (len(mechanism.joint(name).speed_units) - 1) for name, turn in turns.items()
    }
    return mechanism, lx.assemble(mechanism, of_kind(turning(np.pi / 2)), of_kind(turning(speed)))


LOOPS = {
    "universal and spherical": (lx.Revolute, lx.Universal, lx.Spherical, lx.Revolute),
    "cylindrical": (lx.Revolute, lx.Cylindrical, lx.Cylindrical, lx.Cylindrical),
    "screw": (lx.Screw, lx.Screw, lx.Screw, lx.Screw),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_every_joint_type_passes_singular_configurations(name):
    mechanism, state = rhombus(*LOOPS[name])
    found = lx.simulate(mechanism, state, t1=10.0, accuracy=lx.PRECISE)
    turn = np.pi / 2 + found.ts
    place = found.position("coupler", at="tip")[:, :2]
    exact = np.stack([1.0 + np.cos(turn), np.sin(turn)], axis=-1)
    assert np.max(np.abs(place - exact)) <= 1e-9
    np.testing.assert_allclose(found.passages().times, np.pi * np.array([0.5, 1.5, 2.5]), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("carrier", [lx.Planar, lx.Free])
def test_two_loops_that_share_a_coupler_are_singular_at_once(carrier):
    """The coupler is carried from ground, and both its pins are cut."""
    along = np.array([1.0, 0.0, 0.0])
    crank, rocker = lx.rod("crank", 1.0, 1.0), lx.rod("rocker", 1.0, 1.0)
    coupler = lx.RigidBody("coupler", 1.0, along / 2, [0.01, 1 / 12, 1 / 12], {"base": 0.0 * along, "tip": along})
    in_plane = carrier is lx.Planar
    options = {"axis": "z", "second_axis": "x"} if in_plane else {}
    pin = lambda *ends: lx.Spherical(*ends, cut=True) if in_plane else lx.Revolute(*ends, "z", cut=True)
    joints = [
        lx.Revolute("A", lx.GROUND, crank.at("base"), "z"),
        lx.Revolute("D", lx.GROUND.at([1.0, 0.0, 0.0]), rocker.at("base"), "z"),
        carrier("carrier", lx.GROUND, coupler.at("base"), **options),
        pin("B", crank.at("tip"), coupler.at("base")),
        pin("C", coupler.at("tip"), rocker.at("tip")),
    ]
    mechanism = lx.Mechanism([crank, coupler, rocker], joints)
    place = [0.0, 0.0, 1.0] if in_plane else [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    upright = {"A": np.pi / 2, "D": np.pi / 2, "carrier": place}
    found = lx.simulate(mechanism, lx.assemble(mechanism, upright, {"A": 1.0, "D": 1.0}), t1=10.0, accuracy=lx.PRECISE)
    turn = np.pi / 2 + found.ts
    exact = np.stack([1.0 + np.cos(turn), np.sin(turn)], axis=-1)
    assert np.max(np.abs(found.position("coupler", at="tip")[:, :2] - exact)) <= 1e-9
    assert found.closest < 0.05


@pytest.mark.slow
def test_ten_cut_joints_move_like_one():
    kinds = (lx.Revolute,) * 4
    mechanism, state = rhombus(*kinds, copies=10, speed=-1.0, gravity=9.81)
    assert mechanism.topology.num_rows == 20
    found = lx.simulate(mechanism, state, t1=5.0, accuracy=lx.PRECISE)
    place = found.position("coupler", at="tip")[:, :2] - np.array([1.0, 0.0])
    np.testing.assert_allclose(place, n_four_bar(found.ts, 1), atol=1e-10)
    # Of minimum norm: each carries a tenth of what one would.
    angle, speed = found.joint("A"), found.joint_speed("A")
    along, across = (jnp.cos(angle), jnp.sin(angle)), (-jnp.sin(angle), jnp.cos(angle))
    inward, weight = (9.81 * jnp.sin(angle) - speed**2) / 2.0, -0.981 * jnp.cos(angle)
    single = jnp.stack([inward * e + weight * n for e, n in zip(along, across, strict=True)], axis=-1)
    away = np.abs(np.sin(angle)) > 0.01
    np.testing.assert_allclose(-10.0 * found.reaction("C7").force[away, :2], single[away], atol=1e-6)
    assert not np.any(found.reaction_unique("C7").force)


@pytest.mark.slow
def test_free_rigid_body_keeps_energy_and_angular_momentum_over_a_hundred_turns():
    moments = np.array([1.0, 2.0, 2.5])
    body = lx.RigidBody("body", 2.0, [0.1, 0.2, -0.1], moments)
    mechanism = lx.Mechanism([body], [lx.Free("afloat", lx.GROUND, body)])
    state = lx.assemble(mechanism, speeds={"afloat": [1.0, 0.2, 0.3, 0.1, 0.0, 0.0]})
    found = lx.simulate(mechanism, state, t1=200.0 * np.pi, accuracy=lx.Accuracy(rtol=1e-13))
    turn, omega = found.orientation("body"), found.angular_velocity("body")
    spin = jnp.einsum("tij,j,tkj,tk->ti", turn, moments, turn, omega)
    spin += 2.0 * jnp.cross(found.position("body"), found.velocity("body"))
    assert np.ptp(found.energy()) <= 1e-9 * found.energy()[0]
    assert np.max(np.linalg.norm(spin - spin[0], axis=-1)) <= 1e-9 * np.linalg.norm(spin[0])
    np.testing.assert_allclose(np.linalg.norm(found.q[:, :4], axis=-1), 1.0, rtol=1e-15)


@pytest.mark.slow
def test_a_massless_rod_makes_a_pendulum_of_a_free_body():
    body = lx.RigidBody("bob", 1.0, inertia=[1e-3, 1e-3, 1e-3])
    rod = lx.Distance("rod", lx.GROUND, body, 1.0)
    mechanism = lx.Mechanism([body], [lx.Free("free", lx.GROUND, body)], [lx.Gravity([0.0, -9.81, 0.0])], [rod])
    state = lx.assemble(mechanism, guess={"free": [1.0, 0.0, 0.0, 0.0, 1.2, 0.0, 0.0]})
    found = lx.simulate(mechanism, state, t1=10.0, accuracy=lx.PRECISE)
    known = reference("A01_pendulum")
    bob = found.position("bob")
    np.testing.assert_allclose(bob[::10, 0], known["x"][:21], atol=1e-9)
    force, moment = found.reaction("rod")
    tension = found.velocity("bob") ** 2 @ np.ones(3) - 9.81 * bob[:, 1]
    np.testing.assert_allclose(force, -tension[:, None] * bob, atol=1e-8)
    np.testing.assert_allclose(moment, 0.0, atol=1e-12)


def swinging(amplitude, t):
    return 0.3 + amplitude * jnp.sin(2.0 * t)


def driven(crank, amplitude):
    """A crank-slider whose crank is driven: it has no freedom left."""
    changes = {"crank": crank, "angle": 0.3, "speed": 2.0 * amplitude}
    mechanism, state = turning(SCENES["crank-slider"].settings(changes=changes))
    motor = lx.Drive("motor", "bearing", jax.tree_util.Partial(swinging, amplitude))
    return lx.Mechanism(mechanism.bodies, mechanism.joints, mechanism.forces, [motor]), state


def test_a_drive_moves_its_joint_and_its_torque_does_the_work():
    mechanism, state = driven(0.5, 1.0)
    found = lx.simulate(mechanism, state, t1=3.0, accuracy=lx.PRECISE)
    angle, speed = swinging(1.0, found.ts), found.v[:, mechanism.topology.speeds["bearing"]][:, 0]
    of = mechanism.topology.coordinates
    np.testing.assert_allclose(found.q[:, of["bearing"]][:, 0], angle, atol=1e-14)
    slider = 0.5 * np.cos(angle) + np.sqrt(1.0 - (0.5 * np.sin(angle)) ** 2)
    np.testing.assert_allclose(found.q[:, of["guide"]][:, 0], slider, atol=1e-13)
    power = found.reaction("motor") * speed
    work = np.cumsum((power[1:] + power[:-1]) / 2.0 * np.diff(found.ts))
    gained = found.energy()[1:] - found.energy()[0]
    np.testing.assert_allclose(work, gained, atol=2e-3 * np.max(gained))
    assert np.all(found.reaction_unique("motor"))


def test_a_drive_that_asks_for_the_impossible_is_named_with_its_time():
    mechanism, state = driven(1.2, 1.0)
    # The crank cannot turn further than the rod reaches: 1.2 sin(angle) = 1.
    latest = np.arcsin((np.arcsin(1.0 / 1.2) - 0.3) / 1.0) / 2.0
    with pytest.raises(lx.SimulationError, match=r"drive 'motor' of joint 'bearing' asks for what the loops") as error:
        lx.simulate(mechanism, state, t1=3.0)
    np.testing.assert_allclose(error.value.solution.t_end, latest, rtol=1e-4)
    np.testing.assert_allclose(float(str(error.value).split("t = ")[1].split(" s")[0]), latest, rtol=1e-4)


def test_a_force_that_is_not_finite_is_named():
    mechanism = pendulum(forces=[lx.JointTorque("hinge", lambda t, motion: jnp.sqrt(0.5 - t))])
    with pytest.raises(lx.SimulationError, match=r"at t = 0\.5 s.*load of JointTorque on 'hinge' is not finite"):
        lx.simulate(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1)), t1=1.0)


@pytest.mark.parametrize("case", [pytest.param("on a table", marks=pytest.mark.slow), "about its own rope"])
def test_bodies_that_move_without_mass_are_named(case):
    bead, rod = lx.point_mass("bead", 1.0), lx.rod("rod", 1.0, 1.0)
    if case == "on a table":
        holds, at = lx.Planar("table", lx.GROUND, bead, "z"), {"hinge": 0.0, "table": 3 * [0.0]}
    else:
        # Its inertia is not zero but the square of rounding.
        holds = lx.Universal("hook", rod.at("tip"), bead.at([0.0, 0.7, 0.0]), axis="z", second_axis="y")
        at = {"hinge": 0.4, "hook": [0.3, 0.1]}
    mechanism = lx.Mechanism([bead, rod], [holds, lx.Revolute("hinge", lx.GROUND, rod.at("base"), "z")])
    q = np.concatenate([np.atleast_1d(at[name]) for name in mechanism.topology.coordinates])
    state = lx.State(q, np.zeros_like(q))
    with pytest.raises(lx.SimulationError, match=r"before it began: Bodies without mass.*They are 'bead'\.$"):
        lx.simulate(mechanism, state, t1=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("bearing", [lx.Revolute, lx.Cylindrical])
def test_shafts_turn_alike_whatever_angle_is_between_them(bearing):
    """In line, nearly so, and bent: M t² / (2 I) more, without wobble, though a massless body closes the loop."""
    rotor = lambda name: lx.RigidBody(name, 1.0, np.zeros(3), np.array([[0.03, 0, 0], [0, 0.03, 0], [0, 0, 0.04]]))

    def turned(bend, angle):
        first, second = rotor("first"), rotor("second")
        c, s = jnp.cos(bend), jnp.sin(bend)
        end = lx.GROUND.at([0.2, 0.0, 0.0], jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
        joints = [
            lx.Revolute("in", lx.GROUND, first, "x"),
            lx.ConstantVelocity("cv", first.at([0.2, 0.0, 0.0]), second, "x"),
            bearing("out", end, second, "x"),
        ]
        shafts = lx.Mechanism([first, second], joints, [lx.JointTorque("in", 0.5)])
        start = lx.assemble(shafts, {"in": angle}, {"in": 3.0}, guess={"cv": [0.0, bend]})
        found = lx.simulate(shafts, start, t1=0.3, saveat=diffrax.SaveAt(t1=True), throw=False)
        return found.result == lx.RESULTS.successful, found.joint("in")[-1], jnp.ravel(found.joint("out"))[0]

    bends = np.array([0.0, 0.0, 1e-17, 1e-15, 1e-12, 1e-9, 1e-8, 1e-6, 1e-3, 0.35, 0.35, 0.6435])
    angles = np.where(np.arange(len(bends)) % 2, 0.3, 0.0)
    right, driving, driven = jax.vmap(turned)(bends, angles)
    assert np.all(right)
    np.testing.assert_allclose(driving, angles + 0.3 * 3.0 + 0.5 * 0.3**2 / 0.12, rtol=1e-9)
    np.testing.assert_allclose(driven, driving, rtol=1e-9)
