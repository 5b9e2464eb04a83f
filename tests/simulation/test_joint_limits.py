"""Stops of joints by a contact law: restitution, energy, derivatives, convergence to the rigid stop."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import four_bar

import linkax as lx

SAVE_END = diffrax.SaveAt(t1=True)
G, DAMPING = 9.81, 0.02
ENDS = (8.88, 6.96)  # between the tenth bounce and the eleventh, without loss and with it [s]
STEP = 1e-3  # of central differences
SAVES = diffrax.SaveAt(ts=np.linspace(0.0, 0.6, 601))


def ball(law, **ends):
    """A mass on a slide with stops."""
    mass = lx.point_mass("mass", 0.7)
    return lx.Mechanism(
        [mass], [lx.Prismatic("slide", lx.GROUND, mass, "x")], [lx.JointLimit("slide", law, name="stop", **ends)]
    )


@jax.jit
def thrown(numbers, start):
    """Coordinate and speed of a mass between two stops after one hit, by (restitution, exponent, stiffness)."""
    restitution, exponent, stiffness = numbers
    law = lx.ContactLaw(stiffness, exponent, restitution=restitution, impact_speed=2.0)
    mechanism = ball(law, lower=-0.3, upper=0.5)
    accuracy = lx.Accuracy(rtol=1e-10)
    end = lx.simulate(mechanism, lx.State(start[:1], start[1:]), t1=0.3, accuracy=accuracy, saveat=SAVE_END).end
    return jnp.concatenate([end.q, end.v])


CASES = np.array([[0.9, 1.5, 1e5], [0.4, 1.0, 1e4], [0.1, 2.0, 1e6]])


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_restitution_is_what_was_asked_for(side):
    """At the speed that it was given for, whatever the stiffness and the exponent; at both ends."""
    for numbers in CASES:
        found = thrown(jnp.asarray(numbers), jnp.array([0.1, 2.0 * side]))
        np.testing.assert_allclose(found[1], -numbers[0] * 2.0 * side, rtol=1e-7)


@jax.jit
def derivatives(x, scale):
    """Of `thrown`, forwards and backwards."""
    value = lambda x: thrown(x[:3] * scale, x[3:])
    return jax.jacfwd(value)(x), jax.jacrev(value)(x)


@pytest.mark.slow
@pytest.mark.parametrize("case", [0, 1])
def test_derivatives_of_a_hit(case):
    """Forwards and backwards, against central differences; not by an exponent of one, which cannot be smaller."""
    scale = jnp.asarray([1.0, 1.0, CASES[case, 2]])
    x = jnp.concatenate([jnp.asarray(CASES[case]) / scale, jnp.array([0.1, 1.9])])
    forwards, backwards = derivatives(x, scale)
    value = lambda x: thrown(x[:3] * scale, x[3:])
    rise = lambda e: value(x + e) - value(x - e)
    differences = np.stack([(8.0 * rise(e) - rise(2.0 * e)) / (12.0 * STEP) for e in STEP * np.eye(5)], axis=1)
    taken = [0, 1, 2, 3, 4] if CASES[case, 1] > 1.0 else [0, 2, 3, 4]
    size = np.max(np.abs(differences[:, taken]))
    np.testing.assert_allclose(forwards[:, taken], differences[:, taken], atol=1e-6 * size)
    np.testing.assert_allclose(backwards, forwards, atol=1e-9 * size)


@jax.jit
@jax.vmap
def bounced(stiffness):
    """Height and speed after ten bounces on a floor from a height of 1 m, without loss and with it."""

    def end(damping, t1):
        mass = lx.point_mass("mass", 1.0)
        floor = lx.JointLimit("rail", lx.ContactLaw(stiffness, damping=damping), lower=0.0)
        rail = lx.Prismatic("rail", lx.GROUND, mass, "y")
        mechanism = lx.Mechanism([mass], [rail], [lx.Gravity([0.0, -G, 0.0]), floor])
        start, accuracy = lx.State(jnp.ones(1), jnp.zeros(1)), lx.Accuracy(rtol=1e-9)
        found = lx.simulate(mechanism, start, t1=t1, accuracy=accuracy, saveat=SAVE_END).end
        return jnp.stack([found.q[0], found.v[0]])

    return end(0.0, ENDS[0]), end(DAMPING, ENDS[1])


def rigid(damping, bounces):
    """The time of the last one of bounces on a rigid floor, and the speed after it: restitution falls with speed."""
    speed, t = np.sqrt(2.0 * G), np.sqrt(2.0 / G)
    for bounce in range(bounces):
        d, e = damping * speed, 1.0 - 2.0 * damping * speed / 3.0
        for _ in range(50 if damping else 0):  # (1 + e) d = ln((1 + d) / (1 - e d))
            e -= ((1.0 + e) * d - np.log((1.0 + d) / (1.0 - e * d))) / (d - d / (1.0 - e * d))
        speed *= e
        t += 2.0 * speed / G * (bounce < bounces - 1)
    return t, speed


def test_stiffer_stops_come_nearer_to_a_rigid_one():
    """By the power 2/5 of the stiffness, the time of a contact, over ten bounces."""
    stiffness = 1e5 * 2.0 ** (2.5 * np.arange(2, 5))
    for found, damping, end in zip(bounced(jnp.asarray(stiffness)), (0.0, DAMPING), ENDS, strict=True):
        t, speed = rigid(damping, 10)
        exact = np.array([speed * (end - t) - G * (end - t) ** 2 / 2.0, speed - G * (end - t)])
        error = np.abs(np.asarray(found) - exact)
        np.testing.assert_allclose(np.log2(error[-2] / error[-1]), 1.0, atol=0.1)
        assert error[-1, 1] < 10.0 * G * 3.0 * stiffness[-1] ** -0.4


@pytest.mark.slow
def test_stops_in_the_tree_and_cut_are_the_same():
    """At the joint of a four-bar's rocker; cut it has no coordinate of its own; its energy is accounted for."""
    found, law = [], lx.ContactLaw(1e4, damping=0.1)
    stop = lx.JointLimit("rocker_bearing", law, lower=1.7, upper=2.1, name="stop")
    for cut, guess in {"rocker_pin": {"rocker_bearing": 1.9}, "rocker_bearing": {"crank_pin": -0.6}}.items():
        mechanism = four_bar(crank=0.3, coupler=0.7, rocker=0.6, ground=0.8, cut=cut, forces=[stop])
        with pytest.warns(lx.AssemblyWarning, match="'rocker_bearing' is at 1.59.* ends its range"):
            state = lx.assemble(mechanism, {"crank_bearing": 0.9}, {"crank_bearing": 1.0}, guess=guess)
        run = lx.simulate(mechanism, state, t1=0.6, accuracy=lx.Accuracy(rtol=1e-9), saveat=SAVES)
        np.testing.assert_allclose(run.unaccounted_energy(), 0.0, atol=2e-4)
        found.append(np.stack([run.joint("rocker_bearing"), run.force("stop")]))
    force = found[0][1]
    assert np.max(force) > 1.0 > -1.0 > np.min(force)
    np.testing.assert_allclose(found[1], found[0], atol=1e-5 * np.max(np.abs(found[0][1])))


RUBS = lx.ContactLaw(1.0, friction=lx.Friction(0.1, transition_speed=1.0))


@pytest.mark.parametrize(
    ("words", "make"),
    [
        ("restitution None, impact_speed 1.0", lambda: lx.ContactLaw(1.0, impact_speed=1.0)),
        ("damping is 1.0, restitution 0.5", lambda: lx.ContactLaw(1.0, damping=1.0, restitution=0.5, impact_speed=1.0)),
        ("restitution is 1.0; it must lie", lambda: lx.ContactLaw(1.0, restitution=1.0, impact_speed=1.0)),
        ("exponent is 0.5", lambda: lx.ContactLaw(1.0, 0.5)),
        ("stiffness .* is 0.0", lambda: lx.ContactLaw(0.0)),
        ("friction is 0.3; give a linkax.Friction", lambda: lx.ContactLaw(1.0, friction=0.3)),
        ("viscous is 1.0 and viscous_force is None", lambda: lx.Friction(0.1, transition_speed=1.0, viscous=1.0)),
        ("neither lower nor upper", lambda: lx.JointLimit("a", lx.ContactLaw(1.0))),
        ("upper must be larger", lambda: lx.JointLimit("a", lx.ContactLaw(1.0), lower=1.0, upper=1.0)),
        ("law is 1.0; give", lambda: lx.JointLimit("a", 1.0, lower=0.0)),
        ("its law has friction", lambda: lx.JointLimit("a", RUBS, lower=0.0)),
    ],
    ids=lambda entry: entry if isinstance(entry, str) else "",
)
def test_bad_stops_are_refused(words, make):
    with pytest.raises(ValueError, match=words):
        make()
