"""Answers from elsewhere: the files in `data`, and closed forms."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from mechanisms import with_cut
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipj, ellipk

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.dynamics import mass_matrix, potential_energy
from linkax.equations.system import system_of
from linkax.scenes import SCENES


def reference(name):
    """A file of `data` as a record array."""
    return np.genfromtxt(Path(__file__).parent / "data" / f"{name}.csv", delimiter=",", names=True)


def mechanism_of(name, variant=None, changes=None):
    """Mechanism of a scene."""
    return SCENES[name].mechanism(SCENES[name].settings(variant, changes))


def start(name, variant=None, changes=None):
    """Mechanism and initial state of a scene."""
    mechanism = mechanism_of(name, variant, changes)
    return mechanism, SCENES[name].initial(mechanism, SCENES[name].settings(variant, changes))


def n_four_bar(times, count, gravity=9.81):
    """Position of B0 in A02 (LIM/IFToMM library), by Jacobi's elliptic functions."""
    times = np.asarray(times)
    c = gravity * ((count + 1) / 2 + count) / ((count + 1) / 3 + count)
    m = 4 * c / (1 + 4 * c)
    sn, cn, _, _ = ellipj(times / 2 * np.sqrt(1 + 4 * c) - ellipk(m), m)
    return np.stack([-2 * cn * sn, 1 - 2 * cn**2], axis=-1)


@functools.cache
def rise_of_sarrus(angle, speed, duration):
    """Angle of the legs of a Sarrus linkage (`mechanisms.raised`) after some time, from its one equation of motion."""
    length, mass, width, platform, gravity = 0.5, 0.5, 0.02, 2.0, 9.81
    own = mass * (length**2 + width**2) / 12.0
    still = 4.0 * own + mass * length**2
    turning = (4.0 * mass + 4.0 * platform) * length**2  # of cos², next to what stays
    weight = gravity * length * (4.0 * mass + 2.0 * platform)

    def rates(_, y):
        cosine, sine = np.cos(y[0]), np.sin(y[0])
        inertia = still + turning * cosine**2
        return [y[1], (turning * cosine * sine * y[1] ** 2 - weight * cosine) / inertia]

    found = solve_ivp(rates, (0.0, duration), [angle, speed], method="DOP853", rtol=3e-14, atol=1e-15)
    return found.y[0, -1]


class TimeOfTurn:
    """When a linkage of one freedom in gravity reaches which turn φ of its first link: t = ∫ √(J / 2 (E − V)) dφ.

    J and V are of period 2π, and the Fourier series of the integrand is integrated; the motion may not turn back.
    `coordinates`: φ, (n,), ↦ q and its derivative by φ, (n, n_q).
    """

    def __init__(self, mechanism, coordinates, count=512):
        self.coordinates, self.orders = coordinates, np.arange(count) - count // 2
        system = system_of(mechanism, jnp.dtype(float))

        def energies(q, slopes):
            configuration = configure(system, 0.0, q)
            return slopes @ mass_matrix(configuration) @ slopes, potential_energy(configuration)

        found = jax.jit(jax.vmap(energies))(*coordinates(2.0 * np.pi * np.arange(count) / count))
        self.inertia, self.potential = (np.asarray(part) for part in found)

    def _series(self, values):
        return np.fft.fftshift(np.fft.fft(values)) / len(values)

    def _sum(self, series, turn):
        return np.real(np.exp(1j * np.multiply.outer(turn, self.orders)) @ series)

    def energy(self, above):
        """The energy above the highest potential by so many times what that varies [J]."""
        return np.max(self.potential) + above * np.ptp(self.potential)

    def speed(self, turn, energy):
        """φ̇ there, as it rises [1/s]."""
        inertia, potential = (self._sum(self._series(part), turn) for part in (self.inertia, self.potential))
        return np.sqrt(2.0 * (energy - potential) / inertia)

    def clock(self, energy):
        """φ ↦ t, as φ rises."""
        series = self._series(np.sqrt(self.inertia / (2.0 * (energy - self.potential))))
        assert np.abs(series[0]) <= 1e-13 * np.max(np.abs(series))  # so many orders are enough
        integral = np.divide(series, 1j * self.orders, out=np.zeros_like(series), where=self.orders != 0)
        mean = np.real(series[self.orders == 0][0])
        return lambda turn: mean * np.asarray(turn) + self._sum(integral, turn)

    def turn(self, energy, time):
        """The turn at a time of the clock."""
        clock = self.clock(energy)
        periods = np.floor(time / (clock(2.0 * np.pi) - clock(0.0)))
        about = 2.0 * np.pi * periods
        return brentq(lambda turn: clock(turn) - time, about - 4.0 * np.pi, about + 4.0 * np.pi, xtol=1e-14, rtol=1e-14)


def turning(parameters, forces=None):
    """Crank-slider of scene "crank-slider" and its state, from its angle and speed; the rod is carried by the slider.

    `forces`: others than those of the scene.

    So a long rod is not in the inertia of a short crank, of which rounding would leave little.
    """
    mechanism = with_cut(SCENES["crank-slider"].mechanism(parameters), "crank_pin")
    if forces is not None:
        mechanism = lx.Mechanism(mechanism.bodies, mechanism.joints, forces)
    crank, rod, angle, speed = (parameters[name] for name in ("crank", "rod", "angle", "speed"))
    inclination, rate = -angle, -speed
    if crank != rod:
        inclination = -np.arcsin(crank / rod * np.sin(angle))
        rate = -crank / rod * np.cos(angle) / np.cos(inclination) * speed
    distance = crank * np.cos(angle) + rod * np.cos(inclination)
    slide = -crank * np.sin(angle) * speed - rod * np.sin(inclination) * rate
    q = {"bearing": angle, "guide": distance, "wrist_pin": -inclination}
    v = {"bearing": speed, "guide": slide, "wrist_pin": -rate}
    ordered = lambda of: np.array([of[name] for name in mechanism.topology.coordinates])
    return mechanism, lx.State(ordered(q), ordered(v))


def crank_slider(parameters, times):
    """Angle and speed of the crank of scene "crank-slider", (2, n_t): one equation, of its energy ½ J(θ) θ̇² + V(θ).

    With equal lengths on the branch on which the slider moves. Start: see `turning`.
    """
    crank, rod = parameters["crank"], parameters["rod"]
    crank_mass, rod_mass, slider_mass = (parameters[f"{name}_mass"] for name in ("crank", "rod", "slider"))

    def rates(_, state):
        angle, speed = state
        s, c = np.sin(angle), np.cos(angle)
        # Of the rod from the guide, by θ: its sine and cosine, first and second derivative.
        sine, cosine = -crank / rod * s, c if crank == rod else np.sqrt(1.0 - (crank / rod * s) ** 2)
        first = -1.0 if crank == rod else -crank / rod * c / cosine
        second = 0.0 if crank == rod else (crank / rod * s + sine * first**2) / cosine
        # Derivatives of the places of the rod's middle (half) and of the slider (whole).
        along = lambda part: -crank * s - part * rod * sine * first
        bend = lambda part: -crank * c - part * rod * (cosine * first**2 + sine * second)
        across = crank * c + rod / 2.0 * cosine * first
        across_bend = -crank * s + rod / 2.0 * (cosine * second - sine * first**2)
        inertia = crank_mass * crank**2 / 3.0 + slider_mass * along(1.0) ** 2
        inertia += rod_mass * (along(0.5) ** 2 + across**2 + rod**2 / 12.0 * first**2)
        slope = slider_mass * along(1.0) * bend(1.0)
        slope += rod_mass * (along(0.5) * bend(0.5) + across * across_bend + rod**2 / 12.0 * first * second)
        weight = parameters["gravity"] * (crank_mass * crank / 2.0 * c + rod_mass * across)
        return speed, -(slope * speed**2 + weight) / inertia

    span, start = (0.0, times[-1]), (parameters["angle"], parameters["speed"])
    return solve_ivp(rates, span, start, method="DOP853", rtol=1e-13, atol=1e-16, t_eval=times).y


END = 1.0
ROD = SCENES["crank-slider"].settings(None, {"rod": 2.0, "angle": np.pi / 4})


@functools.cache
def slider_start():
    """The start of `slider_end`, to be called once before any transformation calls that."""
    scene = SCENES["crank-slider"]
    return scene.initial(scene.mechanism(ROD), ROD)


def slider_end(mass):
    """Where the slider is after a second, by the rod's mass."""
    mechanism = SCENES["crank-slider"].mechanism(ROD | {"rod_mass": mass})
    return lx.simulate(mechanism, slider_start(), t1=END).position("slider")[-1, 0]


def known_slider_end(mass):
    """The same from one equation of the crank's angle."""
    angle, _ = crank_slider(ROD | {"rod_mass": mass}, np.array([0.0, END]))[:, -1]
    crank, rod = ROD["crank"], ROD["rod"]
    return crank * np.cos(angle) + np.sqrt(rod**2 - (crank * np.sin(angle)) ** 2)


class Known(NamedTuple):
    """A run whose motion is known.

    - `scene`, `variant`, `changes`: see `start`; `t1` [s].
    - `error`: of a solution at its times [m or rad], (n_t,).
    - `times`: where the answer is known; None for 201 times, evenly.
    """

    scene: str
    variant: str | None
    changes: dict | None
    t1: float
    error: Callable
    times: np.ndarray | None = None

    def simulate(self, **options):
        saveat = None if self.times is None else diffrax.SaveAt(ts=self.times)
        return lx.simulate(*start(self.scene, self.variant, self.changes), t1=self.t1, saveat=saveat, **options)


def _crank_slider(variant):
    known = reference(f"crank_slider_{variant}")
    error = lambda found: np.abs(found.position("slider")[:, 0] - known["x_slider"])
    return Known("crank-slider", variant, None, 5.0, error)


def _circle(found, angle):
    turn = np.asarray(found.ts) + angle
    return np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def _four_bar(changes, exact, t1=10.0):
    error = lambda found: np.linalg.norm(found.position("link_0", at="tip")[:, :2] - exact(found), axis=-1)
    return Known("n-four-bar", "A02", changes, t1, error)


def _four_link(variant):
    def exact(found):
        if variant == "FL3":
            return n_four_bar(found.ts, 1)
        return _circle(found, np.pi / 2 if variant == "FL1" else 0.0)

    def error(found):
        place = found.position("coupler", at="tip")[:, :2] - np.array([1.0, 0.0])
        return np.linalg.norm(place - exact(found), axis=-1)

    return Known("spatial-four-link", variant, None, 20.0, error)


def _bricard():
    known = reference("A04_bricard")
    exact = np.stack([known[f"P3{axis}"] for axis in "xyz"], axis=-1)
    error = lambda found: np.linalg.norm(found.position("rod_2", at="tip") - exact, axis=-1)
    return Known("bricard", "A04", None, 10.0, error, known["t"])


def _crane():
    known = reference("luffing_telescopic_crane_rigid")

    def error(found):
        angle, extension = found.joint("boom") - known["alpha"], found.joint("slide_2") - 1.0 - known["e"]
        return np.maximum(np.abs(angle), np.abs(extension))

    return Known("rigid-crane", None, None, 5.0, error, known["t"])


def _planar_four_bar():
    known = reference("planar_four_bar_particles")
    error = lambda found: np.abs(found.joint("P1") - known["q1"])
    return Known("planar-four-bar", None, None, 30.0, error, known["t"])


# Through singular configurations.
PASSING = {f"SC{i}": _crank_slider(f"SC{i}") for i in (1, 2, 3, 4)}
PASSING["FL1"] = _four_bar({"N": 1, "gravity": 0.0, "speed": 1.0}, lambda found: _circle(found, np.pi / 2))
PASSING["FL2"] = _four_bar({"N": 1, "gravity": 0.0, "speed": 1.0, "angle": 0.0}, lambda found: _circle(found, 0.0))
PASSING |= {f"A02-{n}": _four_bar({"N": n}, lambda found, n=n: n_four_bar(found.ts, n)) for n in (1, 2, 5)}
# With constraints that are redundant all the time, couplings, bodies without mass.
REDUNDANT = {f"spatial {variant}": _four_link(variant) for variant in ("FL1", "FL2", "FL3")}
REDUNDANT |= {"bricard": _bricard(), "rigid-crane": _crane(), "planar-four-bar": _planar_four_bar()}
