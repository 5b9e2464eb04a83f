"""What objects print: names, units and numbers, in a few lines, whatever they hold, and without compiling."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from known_answers import mechanism_of
from mechanisms import POOL

import linkax as lx
from linkax.simulation.read.solution import drawn
from linkax.tables import MOST_ROWS, SMALL, Rows, Table, numbers


def test_a_state_names_joints_with_units():
    mechanism = mechanism_of("crank-slider")
    state = lx.State(np.array([0.25, 0.4, -0.3]), np.array([2.0, -0.1, -2.5]), mechanism.topology)
    head, _, *rows = repr(state).splitlines()
    assert head == "State of 3 joints in the tree"
    assert rows[0].split() == ["bearing", "0.25", "rad", "2", "rad/s"]
    assert {row.split()[0] for row in rows} == set(mechanism.topology.coordinates)
    assert " m " in repr(state)
    assert "<th" in state._repr_html_()
    text = repr(lx.State(jnp.stack([state.q] * 3), jnp.arange(3.0)[:, None] * jnp.ones(3), mechanism.topology))
    assert "a batch of 3" in text
    assert "0 to 2 rad/s" in text
    assert "bearing" in repr(drawn(mechanism, lx.State(state.q, state.v)).end)
    assert "bearing" not in repr(lx.State(state.q, state.v))


def test_a_drive_tells_speed_and_start_with_units():
    load = lx.point_mass("load", 1.0)
    lift = lx.Prismatic("lift", lx.GROUND, load, axis="y")
    winch = lx.Drive("winch", "lift", speed=0.5, start=2.0)
    printed = repr(lx.Mechanism([load], [lift], constraints=[winch]))
    assert "winch Drive lift, speed 0.5 m/s, start 2 m" in " ".join(printed.split())


def test_what_is_traced_or_missing_shows_shapes():
    mechanism = mechanism_of("planar-four-bar")
    state, seen = lx.State.as_drawn(mechanism), []

    def shown(mechanism, state):
        seen.extend(map(repr, (mechanism, state, lx.Reaction(state.q, state.q))))
        return state

    eqx.filter_eval_shape(shown, mechanism, state)
    of_mechanism, of_state, of_reaction = seen
    assert "P1" in of_mechanism
    assert "f64[3,3]" in of_mechanism
    assert "f64[3]" in of_state
    assert "P1" in of_state
    assert "f64[3]" in of_reaction
    for tree in (mechanism, state, lx.Reaction(state.q, state.q), drawn(mechanism, state)):
        shapes = eqx.filter_eval_shape(lambda tree: tree, tree)
        for broken in (shapes, jax.tree.map(lambda _: None, tree), jax.tree.map(lambda _: object(), tree)):
            assert type(tree).__name__ in repr(broken)
            assert str(broken)


def test_rounding_prints_as_no_moment_of_inertia():
    """A slender rod that lies askew has none about its own axis, whatever the eigenvalues of its tensor are."""
    for tip in np.random.default_rng(0).normal(size=(20, 3)):
        rod = lx.rod_between("rod", np.zeros(3), tip, mass=3.0)
        pin = lx.Spherical("pin", lx.GROUND, rod)
        across = f"{np.sum(tip**2) / 4.0:.6g}"
        assert f"(0, {across}, {across}) kg m²" in repr(lx.Mechanism([rod], [pin]))


@pytest.mark.parametrize("kind", POOL)
def test_mechanisms_are_short_and_named(kind):
    mechanism = POOL[kind](0)
    text = repr(mechanism)
    assert text.startswith("Mechanism of ")
    assert len(text.splitlines()) <= 1 + 5 * (1 + MOST_ROWS)
    assert max(map(len, text.splitlines())) < 160
    given = [body.name for body in mechanism.beams] or mechanism.topology.bodies
    for name in (*given, " kg", "Gravity" if kind != "floating" else "Spring"):
        assert name in text


# Joint equations, Grübler–Kutzbach's count in space and in the plane, degrees of freedom, redundant equations.
COUNTS = {
    ("planar-four-bar", None): (20, -2, 1, 1, 3),
    ("crank-slider", "regular"): (20, -2, 1, 1, 3),
    ("spatial-four-link", "FL2"): (20, -2, 1, 2, 4),
    ("bricard", None): (30, 0, None, 1, 1),
    ("pendulum", None): (5, 1, 1, 1, 0),
}


@pytest.mark.parametrize(("scene", "variant"), COUNTS)
def test_mobility_counts_as_textbooks_do(scene, variant):
    mechanism = mechanism_of(scene, variant)
    # Of the structure alone; ranks are those that tests/analysis find.
    found = eqx.filter_eval_shape(lx.mobility, mechanism, lx.State.as_drawn(mechanism))
    equations, spatial, planar, freedoms, redundant = COUNTS[scene, variant]
    assert sum(found.joint_equations.values()) == equations
    assert found.spatial_count == spatial == 6 * mechanism.topology.num_bodies - equations
    assert found.planar_count == planar
    assert freedoms == spatial + redundant
    made = {"rank": np.array(mechanism.topology.num_speeds - freedoms), "degrees_of_freedom": np.array(freedoms)}
    for name, entry in (made | {"num_redundant": np.array(redundant), "distance": np.array(0.5)}).items():
        found = eqx.tree_at(lambda found, name=name: getattr(found, name), found, entry)
    text = repr(found)
    for word in (f"{freedoms} degree", f"{spatial} in space", *mechanism.topology.joints):
        assert word in text
    assert ("in the plane" in text) == (planar is not None)


def bennett(short=0.7, twist=0.6):
    """Bennett's loop of four hinges: opposite links are alike, and sin(twist) / length is the same for all."""
    other = np.arcsin(short * np.sin(twist))

    def end(body, length, angle):
        cosine, sine = np.cos(angle), np.sin(angle)
        return body.at([length, 0.0, 0.0], [[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])

    links = [lx.RigidBody(name, 1.0, inertia=[0.1, 0.1, 0.1]) for name in ("one", "two", "three")]
    sizes = [(1.0, twist), (short, other), (1.0, twist)]
    tips = [end(lx.GROUND, short, other), *(end(link, *size) for link, size in zip(links, sizes, strict=True))]
    pairs = zip("abcd", tips, [*links, lx.GROUND], strict=True)
    return lx.Mechanism(links, [lx.Revolute(name, tip, base, "z") for name, tip, base in pairs])


@pytest.mark.slow
def test_mobility_of_a_bennett_loop():
    mechanism = bennett()
    found = lx.mobility(mechanism, lx.assemble(mechanism, {"a": 0.7}, guess={"b": 2.0}))
    assert (found.spatial_count, found.planar_count, found.degrees_of_freedom, found.num_redundant) == (-2, None, 1, 3)


def test_a_run_tells_how_it_went():
    mechanism = mechanism_of("pendulum")
    solution = lx.simulate(mechanism, lx.State.as_drawn(mechanism), t1=0.1)
    with compilations() as compiled:
        text = repr(solution)
        assert "<table>" in solution._repr_html_()
        assert repr(mechanism)
        assert repr(solution.end)
    assert not compiled
    for word in ("201 times", "from 0 to 0.1 s", "successful", "steps", "Dopri8", *mechanism.topology.joints, "rad/s"):
        assert word in text
    assert len(text.splitlines()) < 10


def test_readings_tell_units_and_ranges():
    line, vectors = np.linspace(0.0, 2.0, 5), np.linspace(0.0, 2.0, 5)[:, None] * np.array([1.0, 0.0, -1.0])
    reaction = repr(lx.Reaction(vectors, 3.0 * vectors))
    for word in ("5 times", "0 to 2 N", "-6 to 0 N m"):
        assert word in reaction
    unique = repr(lx.Reaction(vectors > 0.0, vectors < 0.0))
    for word in ("unique", "4 of 5", "no"):
        assert word in unique
    assert "0 to 2 W" in repr(lx.Power(line, line))
    assert "position" in repr(lx.Violation(line, line, line))
    assert "-2 to 0 m" in repr(lx.Pose(vectors, np.stack([np.eye(3)] * 5)))
    modes = lx.Linearisation(np.array([-2.0, 2.0 * np.pi]), *(np.eye(2),) * 4)
    for word in ("grows by 2 1/s", "6.28319 rad/s", "1 Hz"):
        assert word in repr(modes)
    assert "'motor'" in repr(lx.InverseDynamics({("motor", 0): np.array([1.5])}, line))


def test_fits_and_sweeps():
    swept = lx.sweep(lambda x: {"root": jnp.sqrt(x)}, jnp.array([4.0, -1.0, 9.0]))
    assert "3 members: 2 ended well" in repr(swept)
    assert "2 to 3" in repr(swept)
    assert "the first of them 1" in repr(swept)
    params, names = {"mass": np.array(2.0), "rod": np.array(1.5)}, ["mass", "rod"]
    common = {"params": params, "loss": 0.1, "residual": None, "names": names, "history": {}, "steps": 3}
    covariance = np.diag([np.inf, 0.04])
    channels = {"encoder": lx.Explained(noise=0.1, left=0.1, measured=1.0, is_white=True)}
    ended = {"ended": "converged", "spread": None, "channels": channels}
    fit = lx.Fit(**common, **ended, covariance=covariance, noise=0.5, undetermined=["mass"], on_bound={})
    title, _, mass, rod, _, encoder = repr(fit).splitlines()
    assert encoder.split() == ["encoder", "0.1", "0.1", "1", "99.0%"]
    assert "converged after 3 steps" in title
    assert "not determined" in mass
    assert rod.split() == ["rod", "1.5", "0.2"]
    without = fit._replace(covariance=None, noise=None, undetermined=[])
    assert "rod" in repr(without)


def test_tables_cut_what_is_long():
    table = Table("Title & more", [Rows(("a", "b"), [(str(i), "<i>") for i in range(20)], "things")])
    assert table.text().splitlines()[-1].strip() == f"… and {21 - MOST_ROWS} more things"
    assert "Title &amp; more" in table.html()
    assert "&lt;i&gt;" in table.html()
    assert numbers(np.zeros(SMALL + 1)) == f"f64[{SMALL + 1}](numpy)"
    assert numbers(np.array([1.0, np.nan, 3.0])) == "1 to 3 (1 not finite)"
    assert numbers(np.full(3, np.inf)) == "none finite"
    assert numbers(np.zeros((0, 3)), "m", 1)
    assert numbers(None) == "none"
