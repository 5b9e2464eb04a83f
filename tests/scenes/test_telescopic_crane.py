"""The telescopic crane against beam theory, its rigid counterpart, and itself."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.scenes import SCENES
from linkax.scenes.telescopic_crane import END, HEAD, SECTION, SHEAVE

SCENE = SCENES["telescopic-crane"]


def tip(mechanism, state):
    return np.asarray(lx.Solution.of_state(mechanism, state).position("section_3", at="tip")[0])


def along(parameters):
    """The direction of the boom, and the one across it, in its plane."""
    c, s = np.cos(parameters["angle"]), np.sin(parameters["angle"])
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


def chain_of_beams(parameters):
    """How far the tip gives way across the boom, by a chain of straight beams (Euler and Bernoulli), by virtual work.

    Each section stands on two pads; cylinders and ropes act along the boom, ropes above its axis. Small deflections.
    """
    gravity, extension = parameters["gravity"], parameters["extension"]
    across, lengthwise = gravity * np.cos(parameters["angle"]), gravity * np.sin(parameters["angle"])
    beams = [SCENE.mechanism(parameters).body(f"section_{index}") for index in (1, 2, 3)]
    density = np.array([float(beam.section.linear_density) for beam in beams])
    stiffness = np.array([float(beam.section.bending_stiffness[1]) for beam in beams])
    near, far = extension, SECTION - extension  # of the shoes, from the rear of the outer and of the inner section

    def moments(load, weights, tension):
        """Bending moments along the sections, from the rear, where these loads act: forces up count as positive."""
        x = np.linspace(0.0, SECTION, 4001)
        found, on_tip, on_shoe = [], -load, 0.0
        for weight, couple in zip(weights[::-1], SHEAVE * tension * np.array([-1.0, 2.0, -1.0]), strict=True):
            couple_at = SECTION - END if found else END
            # The pad that carries it in front: of the first section the luffing cylinder.
            support = far if len(found) < 2 else HEAD
            around_rear = on_tip * SECTION + on_shoe * near - weight * SECTION**2 / 2.0 + couple
            in_front = -around_rear / support
            points = [(SECTION, on_tip), (near, on_shoe), (support, in_front)]
            moment = -weight * (SECTION - x) ** 2 / 2.0 + couple * (x < couple_at)
            found.append(moment + sum(force * np.maximum(place - x, 0.0) for place, force in points))
            rear = -(on_tip + on_shoe + in_front - weight * SECTION)
            on_tip, on_shoe = -in_front, -rear
        return x, np.array(found[::-1])

    tension = (density[2] * SECTION + parameters["payload"]) * lengthwise
    x, real = moments(parameters["payload"] * across, density * across, tension)
    _, virtual = moments(1.0, 0.0 * density, 0.0)
    return np.sum(np.trapezoid(real * virtual, x, axis=1) / stiffness)


@pytest.fixture(scope="module")
def still():
    """At rest with its load, in gravity so small that deflections are."""
    parameters = SCENE.settings("release", {"gravity": 9.81e-3, "payload": 2000.0, "dropped": 0.0})
    mechanism = SCENE.mechanism(parameters)
    return parameters, mechanism, SCENE.initial(mechanism, parameters)


def test_deflection_against_a_chain_of_beams(still):
    parameters, mechanism, state = still
    axis, normal = along(parameters)
    straight = (SECTION + 2.0 * parameters["extension"]) * axis
    deflection = normal @ (straight - tip(mechanism, state))
    np.testing.assert_allclose(deflection, chain_of_beams(parameters), rtol=3e-3)
