"""The motion that scenes tell in closed form, against tables from elsewhere and against its equation."""

import numpy as np
import pytest
from known_answers import reference
from scipy.integrate import solve_ivp

from linkax.scenes import SCENES
from linkax.scenes.closed_form import turned_link

TABLES = [
    ("pendulum", None, {}, "A01_pendulum", ("x", "y"), "bob", 0.0),
    ("n-four-bar", None, {"N": 1}, "A02_nfourbar_N1", ("B0x", "B0y"), "B0", 0.0),
    ("n-four-bar", None, {"N": 2}, "A02_nfourbar_N2", ("B0x", "B0y"), "B0", 0.0),
    ("spatial-four-link", "FL3", {}, "A02_nfourbar_N1", ("B0x", "B0y"), "C", 1.0),
]


@pytest.mark.parametrize(("name", "variant", "changes", "table", "columns", "point", "shift"), TABLES)
def test_against_tables(name, variant, changes, table, columns, point, shift):
    known = reference(table)
    known = known[known["t"] <= 20.0]
    found = SCENES[name].exact(SCENES[name].settings(variant, changes), known["t"])[point]
    np.testing.assert_allclose(found[:, 0] - shift, known[columns[0]], atol=1e-12)
    np.testing.assert_allclose(found[:, 1], known[columns[1]], atol=1e-12)
    np.testing.assert_array_equal(found[:, 2], 0.0)


@pytest.mark.parametrize("stiffness", [9.81, -4.0, 0.0])
@pytest.mark.parametrize("start", [(0.3, -1.0), (1.0, 7.0), (-2.0, -9.0), (10.0, 0.0), (-np.pi / 2, 0.5)])
def test_against_its_equation(stiffness, start):
    times = np.linspace(0.0, 5.0, 21)
    equation = lambda _, y: [y[1], -stiffness * np.cos(y[0])]
    angle = solve_ivp(equation, (0.0, 5.0), start, method="DOP853", rtol=1e-12, atol=1e-12, t_eval=times).y[0]
    found = turned_link(times, stiffness, *start)
    np.testing.assert_allclose(found[:, 0], np.cos(angle), atol=1e-8)
    np.testing.assert_allclose(found[:, 1], np.sin(angle), atol=1e-8)


@pytest.mark.parametrize("start", [(np.pi / 2, 0.0), (np.pi / 2, 1e-5), (np.pi / 2 - 1e-5, 0.0)])
def test_next_to_rest_upright_there_is_no_answer(start):
    assert turned_link(np.linspace(0.0, 5.0, 21), 9.81, *start) is None
