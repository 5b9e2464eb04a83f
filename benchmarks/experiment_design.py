"""A four-bar from its encoders alone: a designed excitation against arbitrary ones of the same length and energy.

A torque on the crank, a cubic spline in time, excites the linkage; encoders on crank and rocker see it. Unknown are two
masses, friction and a spring. Arbitrary excitations are random splines. They and the designed one have the same
integral of the squared torque, which is what a motor loses as heat. Searches start from the two best of them. Rows, by
criterion: for each parameter the median of its standard errors with arbitrary excitations, and that with the designed
one; with the arbitrary excitation in the middle by the criterion and with the designed one, standard errors as
predicted, and as standard deviations of fits to simulated records with noise. Last, roots of mean squares of these,
relative to the parameters.
"""

import time
from collections.abc import Iterator
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from benchmarks.parts import print_parts

DURATION, COEFFICIENTS = 2.0, 8  # s
TIMES = np.linspace(0.02, DURATION, 100)  # s
NOISE = 1e-3  # rad, of both encoders
ENERGY = 0.02  # N² m² s
ARBITRARY, STARTS, FITS = 21, 2, 100
TRUTH = {"coupler mass": 0.7, "rocker mass": 1.2, "friction": 0.005, "stiffness": 2.0}  # kg, kg, N m s, N m/rad


def torque(coefficients, t):
    """A uniform cubic B-spline [N m]."""
    apart = jnp.abs(t / DURATION * (COEFFICIENTS - 3) - jnp.arange(-1.0, COEFFICIENTS - 1.0))
    near = 2.0 / 3.0 - apart**2 + apart**3 / 2.0
    return jnp.where(apart < 1.0, near, jnp.maximum(2.0 - apart, 0.0) ** 3 / 6.0) @ coefficients


@jax.jit
def energy(coefficients):
    """Integral of the squared torque [N² m² s]."""
    values = jax.vmap(lambda t: torque(coefficients, t))(jnp.linspace(0.0, DURATION, 201))
    return jnp.trapezoid(values**2, dx=DURATION / 200)


def predictions(params, coefficients):
    """Angles of crank and rocker over the noise, (2 n_t,)."""
    crank = lx.rod("crank", length=0.3, mass=1.0)
    coupler = lx.rod("coupler", length=0.8, mass=params["coupler mass"])
    rocker = lx.rod("rocker", length=0.6, mass=params["rocker mass"])
    joints = [
        lx.Revolute("bearing", lx.GROUND, crank.at("base"), axis="z"),
        lx.Revolute("crank pin", crank.at("tip"), coupler.at("base"), axis="z"),
        lx.Revolute("pivot", lx.GROUND.at([0.9, 0.0, 0.0]), rocker.at("base"), axis="z"),
        lx.Revolute("rocker pin", coupler.at("tip"), rocker.at("tip"), axis="z", cut=True),
    ]
    forces = [
        lx.JointTorque("bearing", lambda t, motion: torque(coefficients, t)),
        lx.JointDamper("bearing", params["friction"]),
        lx.JointSpring("pivot", params["stiffness"], free=2.0),
    ]
    linkage = lx.Mechanism([crank, coupler, rocker], joints, forces)
    state = lx.assemble(linkage, {"bearing": 1.2}, guess={"crank pin": -1.0, "pivot": 2.0})
    saveat = diffrax.SaveAt(ts=TIMES)
    motion = lx.simulate(linkage, state, t1=DURATION, accuracy=lx.Accuracy(1e-6), saveat=saveat)
    return jnp.concatenate([motion.joint("bearing"), motion.joint("pivot")]) / NOISE


def residual(params, measured, coefficients):
    return predictions(params, coefficients) - measured


def arbitrary(seed):
    """Coefficients of a random torque of the given energy."""
    coefficients = np.random.default_rng(seed).normal(size=COEFFICIENTS)
    return coefficients * np.sqrt(ENERGY / energy(coefficients))


@jax.jit
def covariance(params, coefficients):
    """Of the relative parameters, (p, p)."""
    slopes = jax.jacfwd(predictions)(params, coefficients)
    relative = jnp.stack([slopes[name] * params[name] for name in TRUTH], axis=1)
    return jnp.linalg.inv(relative.T @ relative)


SIZES = {"D": np.linalg.det, "A": np.trace, "E": lambda covariance: np.linalg.eigvalsh(covariance)[-1]}


def simulated(coefficients) -> np.ndarray:
    """Standard deviations of fits to records with noise."""
    exact = np.asarray(jax.jit(predictions)(TRUTH, coefficients))
    found = []
    for seed in range(FITS):
        measured = exact + np.random.default_rng(seed).normal(size=exact.shape)
        start = {name: 1.1 * value for name, value in TRUTH.items()}
        found.append(lx.fit(residual, start, (measured, coefficients), progress=False).params)
    return np.std([[params[name] for name in TRUTH] for params in found], axis=0, ddof=1)


def designed(criterion) -> Iterator[dict]:
    """A row of the search, and one of each parameter."""
    excitations = [arbitrary(seed) for seed in range(ARBITRARY)]
    covariances = [np.asarray(covariance(TRUTH, each)) for each in excitations]
    order = np.argsort([SIZES[criterion](each) for each in covariances])
    middle = excitations[order[ARBITRARY // 2]]
    began = time.perf_counter()
    limits = lambda params, coefficients: {"energy": energy(coefficients) / ENERGY - 1.0}
    search = lambda start: lx.design(predictions, TRUTH, start, limits=limits, criterion=criterion, progress=False)
    searches = [search(excitations[index]) for index in order[:STARTS]]
    found = min(searches, key=lambda found: found.history["criterion"][-1])
    seconds = time.perf_counter() - began
    energies = {"arbitrary": float(energy(middle)), "designed": float(energy(found.design))}
    told = {"search": found.ended, "steps": found.steps, "failed": found.failed, "seconds": seconds}
    yield told | {"energies": energies, "coefficients": np.round(found.design, 3).tolist()}
    values = np.array(list(TRUTH.values()))
    errors = [values * np.sqrt(np.diagonal(each)) for each in covariances]
    after = np.array([found.standard_errors[name] for name in TRUTH])
    kinds = {"arbitrary": np.median(errors, axis=0), "designed": after, "middle": errors[order[ARBITRARY // 2]]}
    kinds |= {"middle, of fits": simulated(middle), "designed, of fits": simulated(found.design)}
    for index, name in enumerate(TRUTH):
        row = {kind: float(each[index]) for kind, each in kinds.items()}
        yield {"parameter": name, "value": TRUTH[name], **row, "ratio": row["arbitrary"] / row["designed"]}
    sizes = {kind: float(np.sqrt(np.mean((each / values) ** 2))) for kind, each in kinds.items()}
    of_fits = sizes["middle, of fits"] / sizes["designed, of fits"]
    yield {"all": "relative", **sizes, "ratio": sizes["middle"] / sizes["designed"], "ratio, of fits": of_fits}


if __name__ == "__main__":
    print_parts(__doc__, {criterion: partial(designed, criterion) for criterion in SIZES})
