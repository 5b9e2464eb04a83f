"""Elements with internal states against closed forms; laws of time through values."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import linkax as lx
from linkax.scenery.scenery import spans

TIMES = np.linspace(0.0, 0.5, 51)
SAVE_END = diffrax.SaveAt(t1=True)
SPEED, START = 0.2, 0.5  # of the slider that a drive moves
SLIDER = lx.point_mass("slider", 2.0)
SLIDE = lx.Prismatic("slide", lx.GROUND, SLIDER, "x")
WALL = lx.GROUND
GAS = {"area": 1e-3, "free_length": 0.4, "pressure": 3e5, "closed": 0.1}
FRICTION = {"coulomb": 5.0, "static": 8.0, "stribeck_speed": 0.3, "stiffness": 400.0, "damping": 2.0, "viscous": 3.0}


@pytest.fixture(scope="module")
def moved():
    """A slider at constant speed, with an element of each kind on it."""
    forces = [
        lx.DCMotor("slide", 12.0, resistance=2.0, inductance=0.1, constant=4.0, current=1.0, name="motor"),
        lx.MaxwellElement(WALL, SLIDER, 100.0, 20.0, 0.3, name="maxwell"),
        lx.LuGreFriction("slide", **FRICTION, name="bristles"),
        lx.FirstOrderSensor(lambda t, motion: motion.joint("slide"), 0.05, unit="m", name="sensor"),
        lx.PneumaticSpring(WALL, SLIDER, **GAS, name="sealed"),
        lx.PneumaticSpring(WALL, SLIDER, **GAS, exponent=1.0, flow=lambda t, motion: 0.5, name="filled"),
    ]
    mechanism = lx.Mechanism([SLIDER], [SLIDE], forces, [lx.Drive("drive", "slide", speed=SPEED, start=START)])
    return lx.simulate(
        mechanism, lx.State(jnp.full(1, START), jnp.full(1, SPEED)), t1=0.5, saveat=diffrax.SaveAt(ts=TIMES)
    )


def test_a_motor_at_constant_speed(moved):
    steady, rate = (12.0 - 4.0 * SPEED) / 2.0, 2.0 / 0.1
    current = steady + (1.0 - steady) * np.exp(-rate * TIMES)
    np.testing.assert_allclose(moved.states("motor")["current"], current, atol=1e-6)
    np.testing.assert_allclose(moved.force("motor"), 4.0 * current, atol=4e-6)


def test_maxwells_element_relaxes(moved):
    first, steady, rate = 100.0 * (START - 0.3), 20.0 * SPEED, 100.0 / 20.0
    pull = steady + (first - steady) * np.exp(-rate * TIMES)
    np.testing.assert_allclose(moved.force("maxwell"), pull, atol=1e-5)


def test_bristles_deflect_up_to_stribecks_curve(moved):
    sliding = 5.0 + 3.0 * np.exp(-((SPEED / 0.3) ** 2))
    deflection = sliding / 400.0 * (1.0 - np.exp(-400.0 * SPEED / sliding * TIMES))
    np.testing.assert_allclose(moved.states("bristles")["deflection"], deflection, atol=1e-8)
    rate = SPEED - 400.0 * SPEED / sliding * deflection
    np.testing.assert_allclose(moved.force("bristles"), -(400.0 * deflection + 2.0 * rate + 3.0 * SPEED), rtol=1e-6)


def test_a_sensor_lags(moved):
    output = START + SPEED * (TIMES - 0.05) - (START - SPEED * 0.05) * np.exp(-TIMES / 0.05)
    np.testing.assert_allclose(moved.states("sensor")["output"], output, atol=1e-7)


def test_gas_is_compressed(moved):
    ratio = (0.4 - 0.1) / (START + SPEED * TIMES - 0.1)
    np.testing.assert_allclose(moved.force("sealed"), -(3e5 * ratio**1.4 - 101325.0) * 1e-3, rtol=1e-9)
    amount = 1.0 + 0.5 * TIMES
    np.testing.assert_allclose(moved.states("filled")["amount"], amount, rtol=1e-9)
    np.testing.assert_allclose(moved.force("filled"), -(3e5 * ratio * amount - 101325.0) * 1e-3, rtol=1e-8)


@pytest.mark.slow
def test_energies_account_for_all_work(moved):
    assert np.max(np.abs(moved.unaccounted_energy())) < 1e-7 * np.max(np.abs(moved.work()["drive"]))
    assert "sealed" not in moved.work()


@pytest.mark.parametrize("exponent", [1.0, 1.0 + 1e-9, 1.4])
def test_the_potential_of_gas_is_its_force_over_the_way(exponent):
    spring = lx.PneumaticSpring(WALL, SLIDER, **GAS, exponent=exponent)
    mechanism = lx.Mechanism([SLIDER], [SLIDE], [spring])

    def at(x):
        return lx.Solution.of_state(mechanism, lx.State(x[None], jnp.zeros(1)))

    slope = jax.grad(lambda x: at(x).potential_energy()[0])(jnp.array(0.7))
    np.testing.assert_allclose(slope, at(jnp.array(0.7)).force(spring)[0], rtol=1e-7)


CYLINDER = {
    "areas": (2e-3, 1.2e-3),
    "closed": 0.4,
    "stroke": 0.6,
    "valve": 1e-7,
    "supply": 2e7,
    "tank": 1e5,
    "dead_volume": 1e-4,
    "pressures": (6e6, 1e7),
}
STIFFNESS = 1.4e9 * (2e-3**2 / (1e-4 + 2e-3 * 0.3) + 1.2e-3**2 / (1e-4 + 1.2e-3 * 0.3))
MASS = 500.0


def at_rest(coordinate):
    return lx.State(jnp.full(1, coordinate), jnp.zeros(1))


class Metered(lx.HydraulicCylinder):
    """A cylinder that also counts the oil in its chambers, at the density of each, over that without pressure [m³]."""

    @property
    def states(self):
        counts = {name: lx.InternalState(0.0, "m³", scale=1e-4) for name in ("oil_a", "oil_b")}
        return {**super().states, **counts}

    def rates(self, t, motion, states):
        flows = self.flows(t, motion, states)
        density = {name: jnp.exp(states[name] / self.bulk_modulus) for name in ("a", "b")}
        oil = {
            "oil_a": density["a"] * (flows["a"] - flows["leakage"]),
            "oil_b": density["b"] * (flows["b"] + flows["leakage"]),
        }
        return {**super().rates(t, motion, states), **oil}


def cylinder(opening, kind=lx.HydraulicCylinder, force=0.0, **numbers):
    load = lx.point_mass("load", MASS)
    slide = lx.Prismatic("slide", lx.GROUND, load, "x")
    acts_on = ("slide",) if kind is lx.HydraulicActuator else (lx.GROUND, load)
    element = kind(*acts_on, opening, **CYLINDER | numbers, name="cylinder")
    return lx.Mechanism([load], [slide], [element, lx.JointTorque("slide", force)]), at_rest(0.7)


def test_oil_that_flows_in_is_compressed_displaced_or_leaks():
    mechanism, state = cylinder(lambda t, motion: jnp.sin(4.0 * t), Metered, leakage=1e-11, damping=2e3)
    solution = lx.simulate(mechanism, state, t1=0.5, accuracy=lx.PRECISE)
    found = solution.states("cylinder")
    x = solution.q[:, 0] - 0.4
    volumes = {"a": 1e-4 + 2e-3 * x, "b": 1e-4 + 1.2e-3 * (0.6 - x)}
    for name, volume in volumes.items():
        oil = np.exp(found[name] / 1.4e9) * volume
        np.testing.assert_allclose(oil - oil[0], found[f"oil_{name}"], atol=1e-10 * oil[0])
        assert np.max(np.abs(oil - oil[0])) > 1e-2 * oil[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [lx.HydraulicCylinder, lx.HydraulicActuator], ids=["between-points", "along-a-slide"])
def test_a_load_on_locked_oil_swings_as_on_a_spring(kind):
    """A step of force: x = F / K (1 − cos ω t), with ω² = K / m."""
    mechanism, state = cylinder(0.0, kind, force=100.0)
    frequency = np.sqrt(STIFFNESS / MASS)
    ts = np.linspace(0.0, 6.0 / frequency, 101)
    solution = lx.simulate(mechanism, state, t1=ts[-1], saveat=diffrax.SaveAt(ts=ts))
    moved = 100.0 / STIFFNESS * (1.0 - np.cos(frequency * ts))
    np.testing.assert_allclose(solution.q[:, 0] - 0.7, moved, atol=1e-3 * 200.0 / STIFFNESS)


@pytest.mark.slow
def test_a_controlled_cylinder_is_behind_a_ramp_by_its_speed_over_the_gain():
    """The opening is gain × what it is behind, over the speed at which the valve is fully open."""
    speed, full = 0.05, 1e-7 * (2e7 / 2.0) ** 0.5 / 2e-3

    def lag(gain):
        behind = lambda t, motion: gain / full * (0.7 + speed * t - motion.length("cylinder"))
        mechanism, state = cylinder(behind, lx.HydraulicActuator, areas=(2e-3, 2e-3), tank=0.0, damping=1e4)
        solution = lx.simulate(mechanism, state, t1=4.0, saveat=SAVE_END)
        np.testing.assert_allclose(solution.length("cylinder"), solution.q[:, 0], rtol=1e-15)
        return 0.7 + 4.0 * speed - solution.end.q[0]

    drop = (2e7 - speed * 1e4 / 2e-3) / 2.0  # in each half of the valve, less what moves the seals
    lags = np.array([lag(jnp.array(gain)) for gain in (5.0, 10.0)])
    np.testing.assert_allclose(lags, speed / np.array([5.0, 10.0]) * np.sqrt(1e7 / drop), rtol=1e-4)


@pytest.mark.slow
def test_a_rotary_actuator_turns_as_far_as_its_oil():
    """An arm on a hinge, without load and leakage, moves by the oil over the volume of a radian."""
    opening = lx.PiecewiseLinear([0.0, 0.1, 0.4, 0.5], [0.0, 0.5, 0.5, 0.0])
    numbers = {"areas": (2e-4, 2e-4), "dead_volume": 1e-4, "closed": -1.0, "stroke": 2.0, "valve": 1e-8, "supply": 1e7}
    actuator = lx.HydraulicActuator("hinge", opening, **numbers, damping=20.0, pressures=(5e6, 5e6), name="motor")
    mechanism = lx.Mechanism([ARM], [HINGE], [actuator])
    solution = lx.simulate(mechanism, at_rest(-0.5), t1=1.0, saveat=SAVE_END)
    flow = 0.5 * 0.4 * 1e-8 * np.sqrt(5e6)  # through each half of the valve, with half of the pressure
    assert abs(solution.end.q[0] + 0.5 - flow / 2e-4) < 0.02 * flow / 2e-4
    np.testing.assert_allclose(solution.force("motor")[-1], 0.0, atol=0.1)


def test_a_cylinder_is_drawn():
    mechanism, _ = cylinder(0.0)
    (span,) = spans(mechanism)
    assert (span.kind, span.label) == ("damper", "cylinder: HydraulicCylinder")


ARM = lx.rod("arm", 1.0, mass=1.0)
HINGE = lx.Revolute("hinge", lx.GROUND, ARM, "z")


def hinged(*forces):
    return lx.Mechanism([ARM], [HINGE], [lx.Gravity([0.0, -9.81, 0.0]), *forces])


def test_an_integrator_leaves_no_error():
    gains = {"proportional": 60.0, "integral": 60.0, "derivative": 10.0, "filter_time": 0.01}
    mechanism = hinged(lx.PIDController("hinge", 0.5, **gains, name="controller"))
    solution = lx.simulate(mechanism, at_rest(0.0), t1=20.0, saveat=SAVE_END)
    assert abs(solution.end.q[0] - 0.5) < 1e-7
    weight = 9.81 * 0.5 * np.cos(0.5)
    np.testing.assert_allclose(60.0 * solution.states("controller")["integral"][-1], weight, rtol=1e-6)


@pytest.mark.slow
def test_a_joint_with_stiction_stays():
    """Loaded slowly with less than its static friction, it moves by x = −z₀ ln(1 − F / F_S), and no farther."""
    friction = {"coulomb": 5.0, "static": 6.0, "stribeck_speed": 0.1, "stiffness": 1e3, "damping": 20.0}
    torque = lx.JointTorque("hinge", lx.Spline([0.0, 5.0], [0.0, 4.0]))
    mechanism = lx.Mechanism([ARM], [HINGE], [torque, lx.LuGreFriction("hinge", **friction, name="friction")])
    saveat = diffrax.SaveAt(ts=np.array([6.0, 10.0]))
    solution = lx.simulate(mechanism, at_rest(0.0), t1=10.0, saveat=saveat)
    np.testing.assert_allclose(solution.force("friction"), -4.0, rtol=1e-6)
    np.testing.assert_allclose(solution.states("friction")["deflection"], 4.0 / 1e3, rtol=1e-6)
    np.testing.assert_allclose(solution.joint("hinge"), -6.0 / 1e3 * np.log(1.0 - 4.0 / 6.0), rtol=1e-3)


RISE = np.array([0.0, 0.3, 0.5, 1.2])
VALUES = np.array([1.0, 2.0, 0.5, 0.7])


def test_laws_go_through_their_values():
    ts = np.array([-1.0, 2.0, 1.0, *np.linspace(0.0, 1.2, 50)])
    linear, spline = lx.PiecewiseLinear(RISE, VALUES), lx.Spline(RISE, VALUES, end_slopes=(0.3, -1.0))
    reference = CubicSpline(RISE, VALUES, bc_type=((1, 0.3), (1, -1.0)))
    vectors = lx.Spline(RISE, np.stack([VALUES, -VALUES, 0.0 * VALUES], axis=1))
    natural, line = lx.Spline(RISE, VALUES), lx.Spline([0.0, 2.0], [0.0, 1.0])
    laws = (linear, spline, jax.grad(spline), natural, vectors, line)
    lines, splines, slopes, numbers, rows, shares = jax.jit(lambda ts: [jax.vmap(law)(ts) for law in laws])(ts)
    np.testing.assert_allclose(lines, np.interp(ts, RISE, VALUES), rtol=1e-14)
    np.testing.assert_allclose(splines[:2], VALUES[[0, -1]], rtol=1e-14)
    np.testing.assert_allclose(splines[2:], reference(ts[2:]), rtol=1e-13)
    np.testing.assert_allclose(slopes[4:-1], reference(ts[4:-1], 1), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rows, numbers[:, None] * np.array([1.0, -1.0, 0.0]))
    np.testing.assert_allclose(shares[2], 0.5)


def test_wrong_numbers_are_told():
    with pytest.raises(ValueError, match="they must rise from each to the next"):
        lx.Spline([0.0, 0.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="give one for each of the 2 times"):
        lx.PiecewiseLinear([0.0, 1.0], [1.0])
    with pytest.raises(ValueError, match="HydraulicCylinder 'cylinder': areas"):
        cylinder(0.0, areas=(0.0, 1.0))
    with pytest.raises(ValueError, match="HydraulicActuator 'cylinder': stroke \\[m or rad\\]"):
        cylinder(0.0, lx.HydraulicActuator, stroke=0.0)
    with pytest.raises(ValueError, match="unknown force or constraint 'jack'; known: 'cylinder'"):
        lx.simulate(*cylinder(lambda t, motion: motion.length("jack")), t1=0.1)
    with pytest.raises(ValueError, match="it must be no smaller than coulomb"):
        lx.LuGreFriction("hinge", **FRICTION | {"static": 1.0})
    with pytest.raises(ValueError, match="it must be larger than closed"):
        lx.PneumaticSpring(WALL, SLIDER, **GAS | {"free_length": 0.1})


@pytest.mark.parametrize(("opening", "end"), [(1.0, r"closed \+ stroke"), (-1.0, "closed")])
def test_a_cylinder_at_its_end_is_named(opening, end):
    with pytest.raises(lx.SimulationError, match=f"piston of HydraulicCylinder.* beyond its end, {end}, where no oil"):
        lx.simulate(*cylinder(100.0 * opening), t1=10.0)


def _controlled(values):
    """Where an arm ends under an element of each kind, and a valve that follows values."""
    motor = lx.DCMotor("hinge", lx.Spline(RISE, values[:4]), resistance=2.0, inductance=values[4], constant=0.5)
    friction = lx.LuGreFriction("hinge", **FRICTION | {"coulomb": 0.1, "static": 0.2, "stiffness": 30.0 * values[5]})
    controller = lx.PIDController("hinge", 0.4, proportional=3.0, integral=values[6], derivative=0.5, filter_time=0.1)
    post = lx.GROUND.at([0.0, 1.5, 0.0])
    maxwell = lx.MaxwellElement(post, ARM.at("tip"), 5.0, 3.0 * values[7], 1.0)
    areas = {"areas": (2e-5, 1.2e-5), "dead_volume": 1e-5, "valve": 1e-8, "closed": 0.5, "stroke": 2.0}
    opening = lx.PiecewiseLinear([0.0, 0.8], 0.1 * values[:2])
    jack = lx.HydraulicCylinder(post, ARM.at("tip"), opening, **CYLINDER | areas | {"supply": 1e6})
    rotary = {"areas": (2e-5, 2e-5), "dead_volume": 1e-5, "valve": 1e-8, "closed": -1.0, "stroke": 4.0, "supply": 1e6}
    turning = lx.HydraulicActuator("hinge", opening, **CYLINDER | rotary, leakage=1e-12 * values[0])
    mechanism = hinged(motor, friction, controller, maxwell, jack, turning)
    solution = lx.simulate(mechanism, at_rest(0.3), t1=0.6, accuracy=lx.PRECISE)
    return jnp.concatenate([solution.end.q, solution.end.internal / jnp.array([1.0, 0.01, 1.0, 1.0, 1.0, *[1e6] * 4])])


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
def test_derivatives(mode):
    values = jnp.array([*VALUES, 0.3, 1.0, 2.0, 1.0])
    final, changes = jax.jit(_controlled), np.diag(1e-4 * values)
    central = np.stack([(final(values + h) - final(values - h)) / (2.0 * np.sum(h)) for h in changes], axis=1)
    found = jax.jit(mode(_controlled))(values)
    np.testing.assert_allclose(found, central, atol=1e-6 * np.max(np.abs(central)))
