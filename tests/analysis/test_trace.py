"""Kinematics without time: closed forms, turning points, singular configurations, inverse kinematics, workspaces."""

import jax
import jax.numpy as jnp
import mechanisms
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import linkax as lx
from benchmarks.kinematics import LENGTHS, four_bar, rocker_angle
from linkax.analysis.course import _spline

UP = {"D": 1.5}
TURN = np.linspace(0.0, 2.0 * np.pi, 101)
rocker_angles = jax.jit(jax.vmap(lambda crank: rocker_angle(LENGTHS, crank)))


@pytest.fixture(scope="module")
def linkage():
    mechanism = four_bar(LENGTHS)
    return mechanism, lx.assemble(mechanism, {"A": 0.0}, {"A": 1.0}, guess=UP)


@pytest.fixture(scope="module")
def turn(linkage):
    return lx.trace(*linkage, {"A": TURN})


def test_closed_form(turn):
    """Positions, speeds and accelerations per unit of the crank, and what is read from them."""
    angle = lambda crank: rocker_angle(LENGTHS, crank)
    speed, rate = jax.jit(jax.vmap(lambda crank: (jax.grad(angle)(crank), jax.grad(jax.grad(angle))(crank))))(TURN)
    np.testing.assert_allclose(turn.joint("D"), rocker_angles(TURN), rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(turn.joint_speed("D"), speed, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(turn.joint_acceleration("D"), rate, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(turn.ts, TURN)
    tip = LENGTHS[0] * np.stack([np.cos(TURN), np.sin(TURN), 0.0 * TURN], axis=1)
    np.testing.assert_allclose(turn.position("crank", "tip"), tip, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(turn.acceleration("crank", "tip"), -tip, rtol=0.0, atol=1e-14)
    assert turn.result == lx.RESULTS.successful
    assert float(np.min(turn.distance)) > 0.1
    assert "101 positions along A" in repr(turn)


def test_forces_and_angles_of_transmission(turn):
    a, b, c, d = LENGTHS
    diagonal = a**2 + d**2 - 2.0 * a * d * np.cos(TURN)
    angle = np.arccos((b**2 + c**2 - diagonal) / (2.0 * b * c))
    np.testing.assert_allclose(
        turn.transmission_angle("C", "D"), np.minimum(angle, np.pi - angle), rtol=0.0, atol=1e-12
    )
    ratio = turn.mechanical_advantage("D")
    np.testing.assert_allclose(ratio, 1.0 / np.asarray(turn.joint_speed("D")), rtol=1e-12)
    # Of the rocker's tip, by its way: the rocker's length times its angle.
    np.testing.assert_allclose(turn.mechanical_advantage("rocker", "tip"), np.abs(ratio) / c, rtol=1e-10)


@pytest.mark.slow
def test_transmission_to_a_slide():
    """Of a crank-slider: μ is a right angle less that between rod and guide."""
    mechanism = mechanisms.crank_slider(rod=1.3)
    start = lx.assemble(mechanism, {"bearing": 0.3}, guess={"guide": 2.2})
    found = lx.trace(mechanism, start, {"bearing": np.linspace(0.3, 1.2, 5)})
    across = np.arcsin(np.sin(found.joint("bearing")) / 1.3)
    np.testing.assert_allclose(found.transmission_angle("wrist_pin", "guide"), np.pi / 2 - across, rtol=0.0, atol=1e-12)
    with pytest.raises(ValueError, match="hold no body in common"):
        found.transmission_angle("crank_pin", "guide")


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.grad])
def test_derivatives(linkage, mode):
    """Of positions and accelerations by lengths and by the values, in both modes, against those of the closed form."""
    start = linkage[1]  # whose numbers have no part in it

    def loss(lengths, shift):
        found = lx.trace(four_bar(lengths), start, {"A": TURN[5:9] + shift})
        return jnp.sum(found.joint("D") ** 2) + jnp.sum(found.joint_acceleration("D"))

    def exact(lengths, shift):
        angle = lambda crank: rocker_angle(lengths, crank)
        crank = TURN[5:9] + shift
        return jnp.sum(jax.vmap(angle)(crank) ** 2) + jnp.sum(jax.vmap(jax.grad(jax.grad(angle)))(crank))

    expected = jax.grad(exact, argnums=(0, 1))(jnp.asarray(LENGTHS), 0.02)
    found = jax.jit(mode(loss, argnums=(0, 1)))(jnp.asarray(LENGTHS), 0.02)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10), found, expected)


def test_values_beyond_a_turning_point(linkage):
    """The rocker turns back before 2.6 rad: an error that says so, or infinity in a batch, which harms no other."""
    values = np.linspace(1.5, 2.6, 12)
    with pytest.raises(
        lx.TraceError, match=r"along D stops between 2.4 and 2.5, position 10 of 12.*arc_length"
    ) as told:
        lx.trace(*linkage, {"D": values})
    assert int(np.sum(np.isfinite(told.value.trace.ts))) == 10
    run = jax.jit(jax.vmap(lambda values: lx.trace(*linkage, {"D": values})))
    both = run(jnp.stack([jnp.asarray(values), jnp.linspace(1.5, 2.4, 12)]))
    assert [bool(ok) for ok in both.result == lx.RESULTS.successful] == [False, True]
    np.testing.assert_array_equal(np.isfinite(both.q[..., 0]).sum(axis=1), [10, 12])
    crank = np.asarray(both.joint("A"))[1]
    np.testing.assert_allclose(rocker_angles(crank), np.linspace(1.5, 2.4, 12), atol=1e-13)


def test_values_next_to_a_turning_point(linkage):
    """Where crank and coupler are in line, the crank is off it by √(c δ) for a rocker that is off by δ."""
    a, b, c, d = LENGTHS
    end = np.pi - np.arccos((d**2 + c**2 - (b - a) ** 2) / (2.0 * d * c))
    for way in ([1e-1, 1e-3, 1e-5, 1e-6], [1e-6, 1e-6, 1e-3, 1e-5], [1e-1, 1e-4, 1e-4, 1e-1]):
        found = lx.trace(*linkage, {"D": end - np.array(way)})
        crank = np.asarray(found.joint("A"))
        np.testing.assert_allclose(rocker_angles(crank), end - np.array(way), rtol=0.0, atol=1e-13)
        slope = jax.vmap(jax.grad(lambda crank: rocker_angle(LENGTHS, crank)))(crank)
        np.testing.assert_allclose(found.joint_speed("A") * slope, 1.0, rtol=1e-8)
        assert np.all(np.asarray(found.joint_speed("A")) < 0.0)  # on the same side of it
    with pytest.raises(lx.TraceError, match=r"position 3 of 4"):
        lx.trace(*linkage, {"D": end - np.array([1e-1, 1e-2, 1e-6, -1e-6])})


def test_arc_length_through_turning_points(linkage):
    """The crank goes around, the rocker to both ends and back; speeds have length one."""
    s = np.linspace(0.1, 12.0, 240)
    found = lx.trace(*linkage, arc_length=s)
    np.testing.assert_allclose(np.linalg.norm(found.v, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(np.sum(found.v * found.v_rate, axis=1), 0.0, atol=1e-14)
    np.testing.assert_allclose(found.joint("D"), rocker_angles(found.joint("A")), rtol=0.0, atol=1e-12)
    assert np.ptp(found.joint("A")) > 2.0 * np.pi
    assert len(np.flatnonzero(np.diff(np.sign(found.joint_speed("D"))))) >= 2
    middle, h = found.q[2:] - found.q[:-2], s[1] - s[0]
    np.testing.assert_allclose(middle / (2.0 * h), found.v[1:-1], atol=2e-3)
    np.testing.assert_allclose((found.v[2:] - found.v[:-2]) / (2.0 * h), found.v_rate[1:-1], atol=4e-3)
    assert lx.trace(*linkage, arc_length=-s).joint("A")[0] < 0.0


@pytest.mark.slow
def test_derivatives_by_arc_length(linkage):
    def loss(lengths):
        mechanism = four_bar(lengths)
        start = lx.assemble(mechanism, {"A": 0.1}, {"A": 1.0}, guess=UP)
        found = lx.trace(mechanism, start, arc_length=np.linspace(0.1, 1.0, 10))
        return jnp.sum(found.q**2) + jnp.sum(found.v_rate)

    lengths, value = jnp.asarray(LENGTHS), jax.jit(loss)
    reverse, forward = jax.jit(jax.grad(loss))(lengths), jax.jit(jax.jacfwd(loss))(lengths)
    aside = 1e-5 * np.eye(4)
    differences = [(value(lengths + change) - value(lengths - change)) / 2e-5 for change in aside]
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)
    np.testing.assert_allclose(reverse, differences, rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_singular_configurations_are_passed_and_told():
    """A parallelogram is flat at zero and half a turn, where its other branch crosses; values lie on both."""
    mechanism = four_bar(np.array([1.0, 2.0, 1.0, 2.0]))
    start = lx.assemble(mechanism, {"A": 0.5}, guess={"D": 0.5, "B": -0.5})
    values = np.array([0.5, 1.5, 2.5, np.pi, 4.0, 5.0, 6.0, 2.0 * np.pi, 7.0])
    found = lx.trace(mechanism, start, {"A": values})
    np.testing.assert_allclose(found.joint("D"), values, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.joint_speed("D"), 1.0, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.joint_acceleration("D"), 0.0, rtol=0.0, atol=1e-11)
    np.testing.assert_array_equal(np.asarray(found.distance) < 1e-6, [0, 0, 0, 1, 0, 0, 0, 1, 0])
    # From there, in the direction of the start's speeds, and with values twice.
    flat = lx.assemble(mechanism, {"A": 0.0}, {"A": 1.0, "D": 1.0}, guess={"D": 0.0, "B": 0.0})
    values = np.array([0.0, 0.0, 1.0, np.pi, np.pi, 3.5, 4.0, 5.0, 6.0])
    found = lx.trace(mechanism, flat, {"A": values})
    np.testing.assert_allclose(found.joint("D"), values, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.joint_speed("D"), 1.0, rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_cut_joints_and_places(linkage, turn):
    """The same turn along a cut joint, along a point's path, and along poses of the coupler."""
    mechanism, _ = linkage
    part = slice(10, 30)
    assert mechanism.topology.joints[-1] == "C"
    poses = turn.poses()["coupler"]
    for along in (
        {"C": np.asarray(turn.joint("C"))[part]},
        {"coupler.base": np.asarray(turn.position("coupler", "base"))[part]},
        {"coupler": lx.Pose(np.asarray(poses.position)[part], np.asarray(poses.orientation)[part])},
    ):
        found = lx.trace(mechanism, turn.state(8), along)
        np.testing.assert_allclose(found.joint("A"), TURN[part], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("count", [2, 3, 4, 60])
def test_values_are_joined_by_the_spline_of_scipy(count):
    """Of several, and its derivatives by the values in both modes."""
    values, places = np.random.default_rng(count).normal(size=(count, 3)), np.arange(count)
    exact, of_each = CubicSpline(places, values), CubicSpline(places, np.eye(count))
    of_one = lambda values: _spline(values[:, :1])
    found, *modes = jax.jit(lambda values: (_spline(values), jax.jacfwd(of_one)(values), jax.jacrev(of_one)(values)))(
        values
    )
    for order in range(2):
        np.testing.assert_allclose(found[order], exact(places, order + 1), rtol=0.0, atol=1e-13)
        for mode in modes:
            np.testing.assert_allclose(mode[order][:, 0, :, 0], of_each(places, order + 1), rtol=0.0, atol=1e-13)


@pytest.mark.slow
def test_poses_turn_without_jumps():
    """Of a free body through two whole turns, whose quaternions come with any sign."""
    body = lx.RigidBody("body", 1.0)
    mechanism = lx.Mechanism([body], [lx.Free("free", lx.GROUND, body)])
    angles = np.linspace(0.0, 4.0 * np.pi, 50)
    turned = np.zeros((50, 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(angles)
    turned[:, 1, 0], turned[:, 0, 1], turned[:, 2, 2] = np.sin(angles), -np.sin(angles), 1.0
    place = np.stack([angles, 0.0 * angles, np.sin(angles)], axis=1)
    start = lx.assemble(mechanism)
    found = lx.trace(mechanism, start, {"body": lx.Pose(place, turned)})
    np.testing.assert_allclose(found.orientation("body"), turned, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(found.position("body"), place, rtol=0.0, atol=1e-13)
    spin = found.angular_velocity("body")[5:-5] @ np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(spin, angles[1], rtol=2e-3)  # as exact as a spline is


@pytest.mark.slow
def test_what_nothing_decides_does_not_move():
    """A coupler between balls does not turn about itself."""
    mechanism = mechanisms.coupler_between_balls()
    start = lx.assemble(mechanism, {"hinge": 0.2}, guess={"slider": [1.3, 0.0, 0.2]})
    found = lx.trace(mechanism, start, {"hinge": np.linspace(0.2, 1.5, 10)})
    along = found.position("coupler", "tip") - found.position("coupler", "base")
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1.0, rtol=1e-12)
    turned = np.einsum("nij,nj->ni", found.orientation("arm"), found.joint_speed("near"))
    np.testing.assert_allclose(np.sum(along * turned, axis=1), 0.0, atol=1e-12)
    crank = np.linspace(0.2, 1.5, 10)
    reach = 0.5 * np.cos(crank) + np.sqrt(1.0 - 0.04 - 0.25 * np.sin(crank) ** 2)
    np.testing.assert_allclose(found.position("slider")[:, 0], reach, rtol=1e-12)


@pytest.mark.slow
def test_drives(linkage):
    """That of a joint which is followed lets go; the motion of a bench is the same."""
    mechanism = four_bar(LENGTHS, [lx.Drive("motor", "A", speed=3.0)])
    found = lx.trace(mechanism, lx.assemble(mechanism, guess=UP), {"A": TURN[:5]})
    np.testing.assert_allclose(found.joint("D"), jax.vmap(lambda a: rocker_angle(LENGTHS, a))(TURN[:5]), atol=1e-13)
    with pytest.raises(lx.TraceError, match="does not reach the first value"):
        lx.trace(mechanism, lx.assemble(mechanism, guess=UP), {"D": np.array([2.0])})


@pytest.mark.slow
def test_a_position_starts_a_run(linkage, turn, tmp_path):
    mechanism, _ = linkage
    solution = lx.simulate(mechanism, turn.state(7), t1=0.01, accuracy=lx.DRAFT)
    np.testing.assert_allclose(solution.joint("A")[0], TURN[7])
    turn.view(tmp_path / "turn.html")
    assert (tmp_path / "turn.html").stat().st_size > 1e5
    with pytest.raises(ValueError, match="a trace has no forces"):
        turn.view(reactions=True)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "neither along nor arc_length"),
        ({"along": {"A": [0.1]}, "arc_length": [1.0]}, "both along and arc_length"),
        ({"along": {}}, "along is empty; give {joint: values}"),
        ({"along": [0.1]}, "along is"),
        ({"along": {"Z": [0.1]}}, "unknown joint or body 'Z'"),
        ({"along": {"A": 0.1}}, r"values of 'A' have shape \(\)"),
        ({"along": {"A": []}}, r"values of 'A' have shape \(0,\)"),
        ({"along": {"A": [0.1, np.nan]}}, "values of 'A' .* must be finite"),
        ({"along": {"A": np.zeros((3, 2))}}, "along of joint 'A'"),
        ({"along": {"A": [0.1], "D": [1.5, 1.6]}}, "different numbers of values"),
        ({"along": {"coupler.tip": np.zeros((3, 2))}}, "coupler.tip"),
        ({"arc_length": [[1.0]]}, r"arc_length has shape \(1, 1\)"),
        ({"arc_length": [2.0, 1.0]}, "arc_length is .* rise or fall"),
        ({"arc_length": [-1.0, 1.0, 2.0]}, "arc_length is .* rise or fall"),
        ({"along": {"A": [0.1]}, "throw": 1}, "throw is 1"),
        ({"along": {"coupler": lx.Pose(np.zeros((2, 3)), [np.eye(3), np.ones((3, 3))])}}, "value 1 is none"),
    ],
)
def test_bad_input(linkage, given, told):
    with pytest.raises(ValueError, match=told):
        lx.trace(*linkage, **given)


def test_what_is_no_ratio_of_forces(linkage):
    found = lx.trace(*linkage, arc_length=[0.1])
    with pytest.raises(ValueError, match="the trace is along the arc length"):
        found.mechanical_advantage("D")


def test_starts_that_are_refused(linkage):
    mechanism, start = linkage
    with pytest.raises(ValueError, match="start is in float32"):
        lx.trace(mechanism, lx.State(start.q.astype(np.float32), start.v.astype(np.float32)), {"A": [0.1]})
    with pytest.raises(ValueError, match="start has no speeds"):
        lx.trace(mechanism, lx.State(start.q, 0.0 * start.v), arc_length=[0.1])


@pytest.fixture(scope="module")
def five_bar():
    a, b, c, d = (lx.rod(name, length, 1.0) for name, length in zip("abcd", (0.5, 0.6, 0.6, 0.5), strict=True))
    joints = [
        lx.Revolute("left", lx.GROUND.at([-0.2, 0.0, 0.0]), a.at("base"), axis="z"),
        lx.Revolute("ab", a.at("tip"), b.at("base"), axis="z"),
        lx.Revolute("bc", b.at("tip"), c.at("tip"), axis="z"),
        lx.Revolute("cd", c.at("base"), d.at("tip"), axis="z"),
        lx.Revolute("right", lx.GROUND.at([0.2, 0.0, 0.0]), d.at("base"), axis="z"),
    ]
    mechanism = lx.Mechanism([a, b, c, d], joints)
    return mechanism, lx.assemble(mechanism, {"left": 2.2, "right": 0.9}, guess={"b.tip": [0.0, 0.8, 0.0]})


@pytest.mark.slow
def test_workspace_of_a_point(five_bar):
    """The point where both legs meet reaches what lies in both annuli."""
    x, y = np.linspace(-1.31, 1.31, 21), np.linspace(-1.27, 1.27, 19)
    found = lx.workspace(*five_bar, {"b.tip": (x, y, [0.0])})
    radii = [np.hypot(x[:, None] - base, y) for base in (-0.2, 0.2)]
    expected = np.all([(radius < 1.1) & (radius > 0.1) for radius in radii], axis=0)
    np.testing.assert_array_equal(found.reached[..., 0], expected)
    place = found.grid(found.position("b", "tip"))[found.reached]
    there = np.stack(np.meshgrid(x, y, [0.0], indexing="ij"), axis=-1)[found.reached]
    np.testing.assert_allclose(place, there, rtol=0.0, atol=1e-9)
    edge = found.grid(found.distance)[found.reached]
    assert np.min(edge) < 0.1 < np.max(edge)
    assert f"{np.sum(expected)} of 399 positions" in repr(found)


@pytest.mark.slow
def test_bad_grids(five_bar):
    with pytest.raises(ValueError, match=r"values of 'b.tip' are .* give those of each axis"):
        lx.workspace(*five_bar, {"b.tip": [0.0, 1.0]})
    with pytest.raises(ValueError, match=r"values of left have shape \(1, 2\)"):
        lx.workspace(*five_bar, {"left": [[0.0, 1.0]]})
    with pytest.raises(ValueError, match="unknown joint or body 'lfet'"):
        lx.workspace(*five_bar, {"lfet": [0.0, 1.0]})
    with pytest.raises(lx.TraceError, match="does not lead from the start to the nearest position"):
        lx.workspace(*five_bar, {"b.tip": ([3.0], [0.0], [0.0])})
    with pytest.raises(ValueError, match="must be known: leave jit"):
        jax.jit(lambda x: lx.workspace(*five_bar, {"left": x, "right": x}).q)(np.array([0.5]))
