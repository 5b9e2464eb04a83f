"""Constraints that a user writes: residuals over points, frames and joints."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx


class OnParabola(lx.AbstractConstraint):
    """Keep a point on y = x² / (2 r) in the plane of the ground: one row, in metres."""

    point: lx.Frame
    radius: float

    def residual(self, t, attached):
        x, y, _ = attached.point_position(self.point)
        return y - x**2 / (2.0 * self.radius)


class Rotating(lx.AbstractConstraint):
    """Keep a point on a line through the origin that turns: it depends on t and on the point together."""

    is_driven = True

    point: lx.Frame
    speed: float

    def residual(self, t, attached):
        x, y, _ = attached.point_position(self.point)
        return y * jnp.cos(self.speed * t) - x * jnp.sin(self.speed * t)


class Alike(lx.AbstractConstraint):
    """Keep a point where another is, and two coordinates equal: rows of several units."""

    units = ("m", "m", "rad")

    first: lx.Frame
    second: lx.Frame
    pair: tuple[str, str] = eqx.field(static=True)

    @property
    def joints(self):
        return self.pair

    def residual(self, t, attached):
        apart = attached.between(self.first, self.second)
        first, second = map(attached.joint, self.pair)
        return jnp.array([apart[0], apart[1], first - second])


BEAD = lx.point_mass("bead", 2.0)


def puck(constraint, gravity=9.81):
    joints = [lx.Rectangular("table", lx.GROUND, BEAD, "z")]
    return lx.Mechanism([BEAD], joints, [lx.Gravity([0.0, -gravity, 0.0])], [constraint])


def on_parabola(radius):
    return puck(OnParabola("wire", BEAD.reference, radius))


def test_a_bead_on_a_wire():
    """Energy, the curve, and the reaction m (g cos φ + κ v²), along the normal: μ = N / |∇g| at the row y − x²/2r."""
    mechanism = on_parabola(0.5)
    state = lx.assemble(mechanism, {("table", 0): 0.4})
    assert lx.mobility(mechanism, state).degrees_of_freedom == 1
    saveat = diffrax.SaveAt(ts=jnp.linspace(0.0, 2.0, 41))
    found = lx.simulate(mechanism, state, t1=2.0, accuracy=lx.PRECISE, saveat=saveat)
    energy, reaction, unique = eqx.filter_jit(
        lambda found: (found.energy(), found.reaction("wire"), found.reaction_unique("wire"))
    )(found)
    x, y = np.asarray(found.q).T
    np.testing.assert_allclose(y, x**2, atol=1e-13)
    np.testing.assert_allclose(energy, energy[0], atol=1e-9)
    slope, speed = 2.0 * x, np.asarray(found.v)[:, 0]
    size = np.sqrt(1.0 + slope**2)
    normal = 2.0 * (9.81 / size + 2.0 * speed**2 / size)  # κ v² = 2 ẋ² / size
    np.testing.assert_allclose(np.asarray(reaction) * size, normal, rtol=1e-9)
    assert np.all(unique)


def reached(radius):
    start = lx.State(jnp.stack([jnp.array(0.4), 0.08 / radius]), jnp.zeros(2))
    return lx.simulate(on_parabola(radius), start, t1=1.0, saveat=diffrax.SaveAt(t1=True)).q[0, 0]


@jax.jit
def derivatives(radius):
    """Where the bead is, and its derivative in both modes."""
    value, forwards = jax.linearize(reached, radius)
    return value, forwards(1.0), *jax.linear_transpose(forwards, radius)(1.0)


@pytest.mark.slow
def test_its_derivatives():
    step, (_, *found) = 1e-5, derivatives(0.5)
    central = (derivatives(0.5 + step)[0] - derivatives(0.5 - step)[0]) / (2.0 * step)
    np.testing.assert_allclose(found, central, rtol=1e-6)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
def test_derivatives_of_its_assembly(derivative):
    """y = x² / (2 r), where x is given."""
    height = lambda radius: lx.assemble(on_parabola(radius), {("table", 0): 0.4}).q[1]
    np.testing.assert_allclose(derivative(height)(0.5), -(0.4**2) / (2.0 * 0.5**2), rtol=1e-9)


def test_a_bead_on_a_turning_line():
    """r̈ = ω² r: away from the axis by cosh; the reaction is 2 m ω ṙ, and its power all that the energy gains."""
    mechanism = puck(Rotating("arm", BEAD.reference, 1.5), gravity=0.0)
    state = lx.State(jnp.array([0.2, 0.0]), jnp.array([0.0, 0.3]))
    found = lx.simulate(mechanism, state, t1=1.2, accuracy=lx.PRECISE)
    reaction, unaccounted = eqx.filter_jit(lambda found: (found.reaction("arm"), found.unaccounted_energy()))(found)
    ts = np.asarray(found.ts)
    np.testing.assert_allclose(np.hypot(*np.asarray(found.q).T), 0.2 * np.cosh(1.5 * ts), rtol=1e-9)
    np.testing.assert_allclose(reaction, 2.0 * 2.0 * 1.5 * 0.3 * np.sinh(1.5 * ts), atol=1e-8)
    np.testing.assert_allclose(unaccounted, 0.0, atol=1e-9)
    assert found.worst_violation().acceleration < 1e-9


@pytest.mark.slow
def test_several_rows_and_joints():
    """A rod welded to another by a constraint that is redundant but for two rows."""
    rods = [lx.rod(name, 1.0, 1.0) for name in ("first", "second")]
    joints = [lx.Revolute(f"hinge {rod.name}", lx.GROUND, rod.at("base"), "z") for rod in rods]
    weld = Alike("weld", rods[0].at("tip"), rods[1].at("tip"), tuple(joint.name for joint in joints))
    mechanism = lx.Mechanism(rods, joints, [lx.Gravity([0.0, -9.81, 0.0])], [weld])
    state = lx.assemble(mechanism, {"hinge first": 0.3})
    found = lx.mobility(mechanism, state)
    assert (found.degrees_of_freedom, found.num_redundant) == (1, 2)
    assert [name for name, _ in found.rows].count("weld") == 3
    solution = lx.simulate(mechanism, state, t1=0.5)
    np.testing.assert_allclose(solution.joint("hinge first"), solution.joint("hinge second"), atol=1e-12)
    assert solution.reaction("weld").shape == (201, 3)
    assert not np.any(solution.reaction_unique("weld")[5])


class Wrong(lx.AbstractConstraint):
    point: lx.Frame
    mistake: str = eqx.field(static=True)

    def residual(self, t, attached):
        match self.mistake:
            case "time":
                return t * attached.point_position(self.point)[0]
            case "shape":
                return attached.point_position(self.point)
            case "body":
                return attached.orientation("table")[0, 0]
            case "joint":
                return attached.joint("hinge")


@pytest.mark.parametrize(
    ("mistake", "told"),
    [
        ("time", "wrong 'wire': its residual or slip reads t; say `is_driven = True`"),
        ("shape", r"residual has shape \(3,\), and units \('m',\) are 1"),
        ("body", "unknown body of wrong 'wire' 'table'; known: 'bead'"),
        ("joint", "unknown joint of wrong 'wire' 'hinge'; known: none"),
    ],
)
def test_mistakes_are_named(mistake, told):
    with pytest.raises(ValueError, match=told):
        puck(Wrong("wire", BEAD.reference, mistake))
