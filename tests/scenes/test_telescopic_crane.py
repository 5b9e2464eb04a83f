"""The telescopic crane against beam theory."""

import numpy as np
from cranes import SCENE, chain_of_beams, deflection


def crane(variant="release", **changes):
    """Parameters, mechanism and start."""
    parameters = SCENE.settings(variant, changes)
    mechanism = SCENE.mechanism(parameters)
    return parameters, mechanism, SCENE.initial(mechanism, parameters)


def test_deflection_against_a_chain_of_beams():
    """In so little gravity that deflections are small."""
    parameters, mechanism, state = crane(gravity=9.81e-3, payload=2000.0, dropped=0.0)
    np.testing.assert_allclose(deflection(mechanism, state, parameters), chain_of_beams(parameters), rtol=3e-3)
