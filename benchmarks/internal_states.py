"""Elements with internal states against closed forms, and what states cost.

Part `cylinder`: a load on a hydraulic cylinder with its valve closed. Rows: its natural frequency by `linearise` and by
the period of a free vibration, against the closed form, and how far a step of force at several sizes moves it from the
answer of the linear model. Part `oil`: flow in less what is compressed, displaced and leaks, relative to the oil in a
chamber, as the valve moves. Part `cost`: a pendulum with a torque, and with a motor that has a current: steps,
milliseconds of a run that is compiled, and seconds until the first is done.
"""

import time
from collections.abc import Iterator

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from benchmarks.parts import print_parts

AREAS, DEAD, MODULUS, MASS = (2e-3, 1.2e-3), 1e-4, 1.4e9, 500.0
STIFFNESS = MODULUS * (AREAS[0] ** 2 / (DEAD + AREAS[0] * 0.3) + AREAS[1] ** 2 / (DEAD + AREAS[1] * 0.3))
REPEATS = 20


class Metered(lx.HydraulicCylinder):
    """A cylinder that counts the oil in its chambers, at the density of each, over that without pressure [m³]."""

    @property
    def states(self):
        return {**super().states, **{name: lx.InternalState(0.0, "m³", scale=DEAD) for name in ("oil_a", "oil_b")}}

    def rates(self, t, motion, states):
        flows, leakage = self.flows(t, motion, states), {"a": -1.0, "b": 1.0}
        density = {name: jnp.exp(states[name] / self.bulk_modulus) for name in leakage}
        oil = {f"oil_{name}": density[name] * (flows[name] + leakage[name] * flows["leakage"]) for name in leakage}
        return {**super().rates(t, motion, states), **oil}


def loaded(opening, force=0.0, kind=lx.HydraulicCylinder, **more):
    """A load on a cylinder, and the state in which its pressures balance."""
    load = lx.point_mass("load", MASS)
    numbers = {"areas": AREAS, "closed": 0.4, "stroke": 0.6, "valve": 1e-7, "supply": 2e7, "dead_volume": DEAD}
    numbers |= {"bulk_modulus": MODULUS, "pressures": (6e6, 1e7), **more}
    jack = kind(lx.GROUND, load, opening, **numbers, name="jack")
    slide = lx.Prismatic("slide", lx.GROUND, load, "x")
    mechanism = lx.Mechanism([load], [slide], [jack, lx.JointTorque("slide", force)])
    return mechanism, lx.assemble(mechanism, {"slide": 0.7})


def cylinder() -> Iterator[dict]:
    """Natural frequency, and steps of force."""
    closed_form = float(np.sqrt(STIFFNESS / MASS))
    linear = float(np.max(lx.linearise(*loaded(0.0)).eigenvalues.imag))
    ts = np.linspace(0.0, 6.0 * np.pi / closed_form, 1201)
    small = [_stepped(force, ts) for force in (1.0, 100.0, 1e4)]
    rises = small[0] - np.mean(small[0])
    crossings = [float(np.interp(0.0, rises[i : i + 2], ts[i : i + 2])) for i in np.flatnonzero(_crosses(rises))]
    vibrating = float(2.0 * np.pi / np.mean(np.diff(crossings)))
    yield {"linearise_rad_s": linear, "relative_to_closed_form": linear / closed_form - 1.0}
    yield {"vibration_rad_s": vibrating, "relative_to_closed_form": vibrating / closed_form - 1.0}
    for force, moved in zip((1.0, 100.0, 1e4), small, strict=True):
        expected = force / STIFFNESS * (1.0 - np.cos(closed_form * ts))
        yield {"force_N": force, "step_error": float(np.max(np.abs(moved - expected)) / np.max(expected))}


def _crosses(values):
    return (values[:-1] < 0.0) & (values[1:] >= 0.0)


def _stepped(force, ts):
    mechanism, state = loaded(0.0, force)
    solution = lx.simulate(mechanism, state, t1=ts[-1], saveat=diffrax.SaveAt(ts=ts), accuracy=lx.PRECISE)
    return np.asarray(solution.joint("slide")) - 0.7


def oil() -> Iterator[dict]:
    """The balance of each chamber."""
    mechanism, state = loaded(lambda t, motion: jnp.sin(4.0 * t), kind=Metered, leakage=1e-11, damping=2e3)
    for accuracy in ("BALANCED", "PRECISE"):
        solution = lx.simulate(mechanism, state, t1=1.0, accuracy=getattr(lx, accuracy))
        found, x = solution.states("jack"), solution.joint("slide") - 0.4
        for name, volume in {"a": DEAD + AREAS[0] * x, "b": DEAD + AREAS[1] * (0.6 - x)}.items():
            held = np.exp(found[name] / MODULUS) * volume
            off = np.max(np.abs(held - held[0] - found[f"oil_{name}"])) / held[0]
            yield {"accuracy": accuracy, "chamber": name, "imbalance": float(off)}


def cost() -> Iterator[dict]:
    """A pendulum with a torque, and with a motor."""
    rod = lx.rod("rod", 1.0, mass=1.0)
    pin = lx.Revolute("pin", lx.GROUND, rod, "z")
    motor = lx.DCMotor("pin", 4.0, resistance=2.0, inductance=0.1, constant=0.5)
    for name, force in {"torque": lx.JointTorque("pin", 1.0), "motor": motor}.items():
        mechanism = lx.Mechanism([rod], [pin], [lx.Gravity([0.0, -9.81, 0.0]), force])
        state = lx.assemble(mechanism, {"pin": 0.3})
        run = lambda mechanism=mechanism, state=state: lx.simulate(mechanism, state, t1=10.0)
        began = time.perf_counter()
        steps = int(jax.block_until_ready(run()).stats["num_steps"])
        first, times = time.perf_counter() - began, []
        for _ in range(REPEATS):
            began = time.perf_counter()
            jax.block_until_ready(run().q)
            times.append(time.perf_counter() - began)
        yield {"element": name, "steps": steps, "ms": 1e3 * min(times), "first_s": first}


if __name__ == "__main__":
    print_parts(__doc__, {"cylinder": cylinder, "oil": oil, "cost": cost})
