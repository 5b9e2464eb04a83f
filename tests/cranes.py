"""What the telescopic crane is compared with: a chain of beams, rigid sections, the spectrum of a motion."""

import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from linkax.scenes import SCENES
from linkax.scenes.telescopic_crane import END, FOOT, HEAD, SECTION, SHEAVE

SCENE = SCENES["telescopic-crane"]
REACH = 26.0  # of the boom [m]
VARIED = {"height_2": 0.6, "modulus": 2.1e11, "payload": 100.0}
DIFFERENCE = 1e-4  # relative


def crane(variant="release", **changes):
    """Parameters, mechanism and start."""
    parameters = SCENE.settings(variant, changes)
    mechanism = SCENE.mechanism(parameters)
    return parameters, mechanism, SCENE.initial(mechanism, parameters)


def deflection(mechanism, state, parameters):
    """How far the tip of the boom gives way across it, from where it were if nothing bent [m]."""
    angle = parameters["angle"]
    tip = lx.Solution.of_state(mechanism, state).position("section_3", at="tip")[0]
    return jnp.sin(angle) * tip[0] - jnp.cos(angle) * tip[1]


def chain_of_beams(parameters):
    """The same, by a chain of straight beams (Euler and Bernoulli) and virtual work, for small deflections [m].

    Each section stands on two pads; cylinders and ropes act along the boom, ropes above its axis.
    """
    gravity, extension = parameters["gravity"], parameters["extension"]
    across, lengthwise = gravity * np.cos(parameters["angle"]), gravity * np.sin(parameters["angle"])
    beams = [SCENE.mechanism(parameters).body(f"section_{index}") for index in (1, 2, 3)]
    density = np.array([float(beam.section.linear_density) for beam in beams])
    stiffness = np.array([float(beam.section.bending_stiffness[1]) for beam in beams])
    overlap = SECTION - extension

    def moments(load, weights, tension):
        """Bending moments along the sections, from the rear, where these loads act: forces up count as positive."""
        x = np.linspace(0.0, SECTION, 4001)
        found, on_tip, on_shoe = [], -load, 0.0
        for index, couple in ((2, -1.0), (1, 2.0), (0, -1.0)):
            couple_at, couple = END if index == 2 else SECTION - END, couple * SHEAVE * tension
            # What carries it in front: a pad, or the luffing cylinder.
            support, weight = overlap if index > 0 else HEAD, weights[index]
            around_rear = on_tip * SECTION + on_shoe * extension - weight * SECTION**2 / 2.0 + couple
            in_front = -around_rear / support
            forces = [(SECTION, on_tip), (extension, on_shoe), (support, in_front)]
            moment = -weight * (SECTION - x) ** 2 / 2.0 + couple * (x < couple_at)
            found.append(moment + sum(force * np.maximum(place - x, 0.0) for place, force in forces))
            rear = weight * SECTION - on_tip - on_shoe - in_front
            on_tip, on_shoe = -in_front, -rear
        return x, np.array(found[::-1])

    tension = (density[2] * SECTION + parameters["payload"]) * lengthwise
    x, real = moments(parameters["payload"] * across, density * across, tension)
    _, virtual = moments(1.0, 0.0 * density, 0.0)
    return np.sum(np.trapezoid(real * virtual, x, axis=1) / stiffness)


def rigid(parameters):
    """The crane, planar, with rigid sections in straight guides, and its start at rest."""
    flexible = SCENE.mechanism(parameters)
    sections = []
    for index in (1, 2, 3):
        section = flexible.body(f"section_{index}").section
        mass = float(section.linear_density) * SECTION
        about = np.array([0.0, 1.0, 1.0]) * mass * SECTION**2 / 12.0
        sections.append(
            lx.RigidBody(f"section_{index}", mass, [SECTION / 2.0, 0.0, 0.0], about, {"tip": [SECTION, 0, 0]})
        )
    first, second, third = sections
    turntable, payload = flexible.body("turntable"), flexible.body("payload")
    above = lambda section, at: section.at([at, SHEAVE, 0.0])
    slewing, luffing, telescoping, rope = flexible.constraints
    joints = [
        lx.Revolute("slew", lx.GROUND, turntable, axis="y"),
        lx.Revolute("pivot", turntable, first, axis="z"),
        lx.Prismatic("extension_2", first, second, axis="x"),
        lx.Prismatic("extension_3", second, third, axis="x"),
        lx.Revolute("hook", third.at("tip"), payload.at([0.0, parameters["hoist"], 0.0]), axis="z"),
    ]
    constraints = [
        slewing,
        lx.Rope("luffing", [turntable.at([*FOOT, 0.0]), first.at([HEAD, 0.0, 0.0])], luffing.length),
        telescoping,
        lx.Rope(rope.name, [above(first, SECTION - END), above(second, SECTION - END), above(third, END)], rope.length),
    ]
    mechanism = lx.Mechanism([turntable, *sections, payload], joints, flexible.forces[:1], constraints)
    angle, extension = parameters["angle"], parameters["extension"]
    guess = {"pivot": angle, "hook": -angle, "extension_2": extension, "extension_3": extension}
    return mechanism, lx.equilibrium(mechanism, lx.assemble(mechanism, guess=guess))


def slopes_and_differences(**changes):
    """Derivatives of deflection [m] and main frequency [Hz] by what is VARIED, (2, 3), and central differences."""
    parameters, _, near = crane(**changes)

    @jax.jit
    def found(numbers):
        changed = parameters | dict(zip(VARIED, numbers, strict=True))
        mechanism = SCENE.mechanism(changed)
        state = lx.equilibrium(mechanism, near)
        modes = lx.linearise(mechanism, state, degrees_of_freedom=10)
        return jnp.stack([deflection(mechanism, state, changed), modes.natural_frequencies[1] / (2.0 * jnp.pi)])

    at = np.array([*VARIED.values()])
    steps = DIFFERENCE * np.diag(at)
    differences = [(found(at + step) - found(at - step)) / (2.0 * np.sum(step)) for step in steps]
    return jax.jit(jax.jacfwd(found))(at), np.stack(differences, axis=1)


def main_frequency(times, values):
    """The strongest frequency [Hz] of values at equally spaced times: the peak of the spectrum, Hann's window."""
    count = len(values)
    spectrum = np.abs(np.fft.rfft((values - np.mean(values)) * np.hanning(count), 16 * count))
    peak = np.argmax(spectrum)
    left, top, right = np.log(spectrum[peak - 1 : peak + 2])
    offset = (left - right) / (left - 2.0 * top + right) / 2.0
    return (peak + offset) / (16 * count * (times[1] - times[0]))
