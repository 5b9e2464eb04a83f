"""The scenes of machines: loops and mobility, and places of pins against closed forms of their own."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.scenes import SCENES
from linkax.scenes.excavator import CYLINDERS, places

# Scene: loops, degrees of freedom without its motors, redundant rows. In the plane each loop has three redundant rows;
# the ring has 16 loops and 24 bodies, of which 1 moves freely, and a count of -8: nine more.
FOUND = {
    "delta": (5, 3, 0),
    "five-bar": (1, 2, 3),
    "excavator": (4, 3, 12),
    "watt-six-bar": (2, 1, 6),
    "stephenson-six-bar": (2, 1, 6),
    "strandbeest": (6, 1, 18),
    "hoberman": (16, 1, 57),
}
SIZE = {"excavator": 5.0}  # [m]; others have one of about a metre or less


@functools.cache
def drawn(name):
    scene = SCENES[name]
    mechanism = scene.mechanism(scene.settings())
    return mechanism, lx.State.as_drawn(mechanism)


def check(name, mechanism, state):
    assert lx.Solution.of_state(mechanism, state).violation().position.max() <= 1e-12 * SIZE.get(name, 0.3)
    undriven = lx.Mechanism(mechanism.bodies, mechanism.joints, mechanism.forces)
    found = lx.mobility(undriven, lx.State(state.q, state.v))
    assert (undriven.topology.num_cuts, found.degrees_of_freedom, found.num_redundant) == FOUND[name]
    assert found.is_planar == (name != "delta")


@pytest.mark.parametrize(
    "name", ["watt-six-bar", *(pytest.param(name, marks=pytest.mark.slow) for name in ("five-bar", "strandbeest"))]
)
def test_loops_and_mobility_as_drawn(name):
    """All coordinates are zero there, and the loops closed."""
    check(name, *drawn(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", FOUND)
def test_loops_and_mobility_as_assembled(name):
    scene, (mechanism, _) = SCENES[name], drawn(name)
    check(name, mechanism, scene.initial(mechanism, scene.settings()))


@pytest.mark.parametrize("count", [(3, 1), (8, 1), (5, 2), (20, 6)])
def test_struts_of_rings(count):
    """n pairs, R rings: 2nR struts, n blocks; a count in the plane is short by what the ring has in excess."""
    pairs, rings = count
    scene = SCENES["hoberman"]
    parameters = scene.settings(changes={"pairs": pairs, "rings": rings, "angle": 1.2 * np.pi / pairs})
    topology = scene.mechanism(parameters).topology
    assert topology.num_bodies == 2 * pairs * rings + pairs
    assert topology.num_cuts == 2 * pairs * rings


@pytest.mark.slow
def test_delta_below_its_centre():
    """Held in the middle, its height follows from the angle of the arms: two sides of a right triangle."""
    scene = SCENES["delta"]
    parameters = scene.settings("held")
    mechanism = scene.mechanism(parameters)
    at = lx.Solution.of_state(mechanism, scene.initial(mechanism, parameters))
    angle = at.joint("motor_2")[0]
    out = parameters["base"] - parameters["platform"] + parameters["arm"] * np.cos(angle)
    depth = parameters["arm"] * np.sin(angle) + np.sqrt(parameters["rod"] ** 2 - out**2)
    np.testing.assert_allclose(at.position("platform")[0], [0.0, 0.0, -depth], atol=1e-14)
    np.testing.assert_allclose(depth, parameters["depth"], atol=1e-14)
    np.testing.assert_allclose(at.orientation("platform")[0], np.eye(3), atol=1e-14)


@pytest.mark.parametrize("name", ["five-bar", "watt-six-bar", "stephenson-six-bar", "strandbeest", "hoberman"])
def test_points_start_on_the_closed_form(name):
    scene = SCENES[name]
    at = lx.Solution.of_state(*drawn(name))
    exact = scene.exact(scene.settings(), np.zeros(1))
    for point, where in scene.points(scene.settings()).items():
        np.testing.assert_allclose(at.position(*where), exact[point], atol=1e-14)


def test_bars_have_their_lengths():
    settings, at = SCENES["strandbeest"].settings(), lx.Solution.of_state(*drawn("strandbeest"))
    ends = {"b": ("hip", "P", "T"), "d": ("hip", "P", "K"), "e": ("hip", "T", "K"), "c": ("c", "P", "H")}
    ends |= {"f": ("f", "K", "Q"), "g": ("foot", "H", "Q"), "h": ("foot", "Q", "F"), "i": ("foot", "H", "F")}
    ends |= {"j": ("j", "A", "T"), "k": ("k", "A", "H")}
    for leg in (1, 2):
        for side, (body, *pins) in ends.items():
            first, second = (at.position(f"{body}_{leg}", pin)[0] for pin in pins)
            np.testing.assert_allclose(np.linalg.norm(second - first), settings[side], atol=1e-14)
    # Jansen's foot is below all else.
    assert at.position("foot_1", "F")[0, 1] < -0.7


@pytest.mark.slow
def test_six_bars_close_at_other_places_of_the_crank():
    """Assembled at angles of the crank, from the drawing on, against circles."""
    scene = SCENES["watt-six-bar"]
    parameters = scene.settings("falling")
    mechanism = scene.mechanism(parameters)
    exact = scene.exact(parameters | {"motor": 1, "speed": 1.0}, np.array([0.0, 0.1, 0.2]))
    for index, turn in enumerate((0.0, 0.1, 0.2)):
        at = lx.Solution.of_state(mechanism, lx.assemble(mechanism, {"A0": turn}))
        np.testing.assert_allclose(at.position("upper", "E")[0], exact["E"][index], atol=1e-12)


def test_radii_of_all_pins():
    scene = SCENES["hoberman"]
    parameters, at = scene.settings(), lx.Solution.of_state(*drawn("hoberman"))
    half, length, angle = np.pi / parameters["pairs"], parameters["length"], parameters["angle"]
    for frame, sign in (("inner", -1.0), ("middle", 0.0), ("outer", 1.0)):
        for pair in range(1, parameters["pairs"] + 1):
            found = np.linalg.norm(at.position(f"left_1_{pair}", frame)[0])
            np.testing.assert_allclose(found, length * np.sin(angle + sign * half) / np.sin(half), atol=1e-15)


@pytest.mark.parametrize(
    ("name", "changes", "told"),
    [
        ("hoberman", {"pairs": 2}, "pairs is 2; a ring has three or more"),
        ("hoberman", {"rings": 5}, r"angle \[rad\] is 0.6; pins keep off the centre between"),
        ("strandbeest", {"j": 0.1}, "place of pin.*links do not reach each other"),
        ("five-bar", {"y": 0.4}, "place of pin 'left_elbow'.*links do not reach each other"),
        ("delta", {"depth": 1.1}, "place of pin 'elbow_1a'.*links do not reach each other"),
    ],
)
def test_lengths_that_make_no_machine(name, changes, told):
    with pytest.raises(ValueError, match=told):
        SCENES[name].mechanism(SCENES[name].settings(changes=changes))


def test_lengths_have_derivatives():
    """The depth of a leg's toe by all lengths, against differences."""
    scene = SCENES["strandbeest"]

    @jax.jit
    def toe(numbers):
        foot = scene.mechanism(scene.settings() | {"legs": 1} | numbers).body("foot_1")
        return (foot.drawn_at + foot.frames["F"])[1]

    lengths = {name: jnp.asarray(scene.parameters[name]) for name in "abcdefghijklm"}
    slopes = jax.jit(jax.grad(toe))(lengths)
    for name in "bk":
        step = 1e-6
        above, below = (toe(lengths | {name: lengths[name] + sign * step}) for sign in (1.0, -1.0))
        np.testing.assert_allclose(slopes[name], (above - below) / (2.0 * step), rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in FOUND if SCENES[name].exact])
def test_driven_motion_is_the_closed_form(name):
    scene = SCENES[name]
    times = jnp.linspace(0.0, 0.4 * scene.t1, 11)
    mechanism, _ = drawn(name)
    state = scene.initial(mechanism, scene.settings())
    found = lx.simulate(mechanism, state, t1=times[-1], saveat=diffrax.SaveAt(ts=times))
    assert found.worst_violation().position <= 1e-14
    exact = scene.exact(scene.settings(), np.asarray(times))
    for point, where in scene.points(scene.settings()).items():
        np.testing.assert_allclose(found.position(*where), exact[point], atol=1e-13)


@pytest.mark.slow
def test_strokes_of_the_excavator():
    """Lengths of its cylinders, from angles of boom, stick and bucket alone, change by strokes; pins stay closed."""
    settings = SCENES["excavator"].settings(changes={"duration": 0.5})
    mechanism = SCENES["excavator"].mechanism(settings)
    found = lx.simulate(mechanism, SCENES["excavator"].initial(mechanism, settings), t1=0.5)
    assert found.worst_violation().position <= 1e-14
    sizes = {name: settings[name] for name in CYLINDERS}

    def lengths(index):
        angles = [settings[f"{name}_angle"] + found.joint(name)[index] for name in CYLINDERS]
        at = places(sizes, *angles)
        return {name: np.linalg.norm(at[f"{name}_head"] - at[f"{name}_foot"]) for name in CYLINDERS}

    begin, end = lengths(0), lengths(-1)
    for name in CYLINDERS:
        np.testing.assert_allclose(end[name] - begin[name], settings[f"{name}_stroke"], atol=1e-13)
