"""Consistent states from partial positions and speeds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import crank_slider

import linkax as lx


@pytest.mark.parametrize("angle", [0.0, np.pi / 4, 1.0, -1.2])
def test_equal_lengths_find_the_sliding_branch(angle):
    mechanism = crank_slider(rod=1.0)
    state = lx.assemble(mechanism, {"bearing": angle}, {"bearing": 2.0})
    place = mechanism.topology.coordinates
    np.testing.assert_allclose(state.q[place["guide"]], 2 * np.cos(angle), atol=1e-12)
    np.testing.assert_allclose(state.v[place["guide"]], -4 * np.sin(angle), atol=1e-12)


def test_a_cut_joint_is_held_as_well_as_one_in_the_tree():
    held_in_tree = lx.assemble(crank_slider(rod=1.5), {"bearing": 0.4}, {"bearing": 2.0})
    cut, guide = crank_slider(rod=1.5, cut="guide"), crank_slider().topology.coordinates["guide"]
    positions, speeds = ({"guide": part[guide][0]} for part in (held_in_tree.q, held_in_tree.v))
    held_where_cut = lx.assemble(cut, positions, speeds, guess={"bearing": 0.3, "crank_pin": -0.5})
    bearing = cut.topology.coordinates["bearing"]
    np.testing.assert_allclose(held_where_cut.q[bearing], 0.4, atol=1e-12)
    np.testing.assert_allclose(held_where_cut.v[bearing], 2.0, atol=1e-12)


def test_the_guess_chooses_the_assembly_mode():
    guess = {"guide": -1.0, "crank_pin": 3.0}
    folded = lx.assemble(crank_slider(rod=1.5), {"bearing": 0.4}, {"bearing": 0.0}, guess=guess)
    place = crank_slider().topology.coordinates
    assert folded.q[place["guide"]][0] < 0.0


def test_contradicting_positions_and_speeds():
    ask = lambda guide, speed: lx.assemble(
        crank_slider(rod=1.0), {"bearing": 0.3, "guide": guide}, {"bearing": 1.0, "guide": speed}
    )
    with pytest.raises(lx.AssemblyError, match=r"does not close|is missed by"):
        ask(0.2, -2.0 * np.sin(0.3))
    with pytest.raises(lx.AssemblyError, match=r"speed asked of joint '(bearing|guide)' is missed"):
        ask(2.0 * np.cos(0.3), 5.0)


def driven_slider(rod=1.5):
    return crank_slider(rod=rod, constraints=[lx.Drive("motor", "bearing", speed=2.0, start=1.2)])


REACHED = np.cos(1.2) + np.sqrt(1.5**2 - np.sin(1.2) ** 2)  # by the guide, where the drive starts
HELD, HOLDS = ", and drive 'motor' holds it at", "drive 'motor' holds 'bearing' at"


@pytest.mark.parametrize(
    ("rod", "positions", "speeds", "told"),
    [
        (1.5, {"bearing": 0.4}, {"bearing": 2.0}, rf"position.*'bearing' is 0\.4 rad{HELD} 1\.2 rad at t = 0 s; leave"),
        (1.5, {"bearing": 1.2}, {"bearing": 3.0}, rf"speed.*'bearing' is 3 rad/s{HELD} 2 rad/s at t = 0 s; leave"),
        (1.5, {"guide": 0.4}, {"guide": 0.0}, rf"does not close.*positions held: 'guide'; {HOLDS} 1\.2 rad"),
        (1.5, {"guide": REACHED}, {"guide": 0.4}, rf"'guide' is missed by .*given \({HOLDS} 2 rad/s\)"),
        (0.5, {}, {}, rf"positions held: none; {HOLDS} 1\.2 rad"),
    ],
)
def test_errors_tell_what_drives_hold(rod, positions, speeds, told):
    with pytest.raises(lx.AssemblyError, match=told):
        lx.assemble(driven_slider(rod), positions, speeds)


def test_what_a_drive_asks_may_be_given_too():
    state = lx.assemble(driven_slider(), {"bearing": 5.2}, {"bearing": 2.0}, t=2.0)
    np.testing.assert_allclose([state.q[0], state.v[0]], [5.2, 2.0], atol=1e-12)


def test_derivative_of_an_assembled_state():
    """Of the slider's place and speed."""

    def found(crank, rod, angle):
        state = lx.assemble(crank_slider(crank=crank, rod=rod), {"bearing": angle}, {"bearing": 1.0})
        return jnp.stack([state.q[1], state.v[1]])

    exact = lambda crank, rod, angle: crank * jnp.cos(angle) + jnp.sqrt(rod**2 - (crank * jnp.sin(angle)) ** 2)
    numbers = (1.0, 1.5, 0.7)
    of_place, of_speed = np.transpose(jax.jacrev(found, (0, 1, 2))(*numbers))
    slopes = [jax.grad(function, (0, 1, 2)) for function in (exact, jax.grad(exact, 2))]
    place, speed = jax.jit(lambda *numbers: [slope(*numbers) for slope in slopes])(*numbers)
    np.testing.assert_allclose(of_place, place, rtol=1e-12)
    np.testing.assert_allclose(of_speed, speed, rtol=1e-10)


@pytest.mark.slow
def test_derivatives_where_only_some_arguments_are_traced():
    speeds = jax.vmap(lambda speed: lx.assemble(crank_slider(rod=1.0), {"bearing": 0.7}, {"bearing": speed}).v[0])
    np.testing.assert_allclose(speeds(jnp.arange(1.0, 3.0)), [1.0, 2.0], rtol=1e-12)
    # What nothing holds follows the guess.
    closed = lx.assemble(crank_slider(rod=1.0), {"bearing": 0.7}, {"bearing": 0.0})
    near = lambda angle: {"bearing": angle, "guide": closed.q[1], "crank_pin": closed.q[2]}
    slope = jax.grad(lambda angle: lx.assemble(crank_slider(rod=1.0), guess=near(angle)).q[0])(0.7)
    step = 1e-4
    found = [lx.assemble(crank_slider(rod=1.0), guess=near(0.7 + sign * step)).q[0] for sign in (1.0, -1.0)]
    np.testing.assert_allclose(slope, (found[0] - found[1]) / (2 * step), rtol=1e-5)


def test_a_search_that_is_stuck_starts_again_beside():
    """The tip has to go to where the bar points away from, a saddle of the gap."""
    bar = lx.rod("bar", 1.0, 1.0)
    hinge, ball = (
        lx.Revolute("hinge", lx.GROUND, bar.at("base"), "z"),
        lx.Spherical("ball", lx.GROUND.at([-1.0, 0.0, 0.0]), bar.at("tip"), cut=True),
    )
    state = lx.assemble(lx.Mechanism([bar], [hinge, ball]))
    np.testing.assert_allclose(np.abs(state.q), np.pi, atol=1e-12)


def test_axes_that_point_opposite_ways_are_no_solution():
    """Locked rotations vanish for flipped axes too; the guess is nearer to those."""
    arm, block = lx.rod("arm", 1.0, 1.0), lx.box("block", [0.1, 0.1, 0.1], 1.0)
    joints = [
        lx.Universal("cross", lx.GROUND, arm.at("base"), "z", second_axis="y"),
        lx.Spherical("ball", arm.at("tip"), block),
        lx.Prismatic("guide", lx.GROUND, block, "x", cut=True),
    ]
    flipped = [0.05, 0.0, 0.0, 1.0]
    state = lx.assemble(lx.Mechanism([arm, block], joints), guess={"cross": [0.3, 0.2], "ball": flipped})
    mechanism = lx.Mechanism([arm, block], joints)
    np.testing.assert_allclose(lx.Solution.of_state(mechanism, state).orientation("block")[0], np.eye(3), atol=1e-9)


def test_a_ball_is_held_where_it_is_asked_and_turns_as_asked():
    body = lx.box("body", [1.0, 2.0, 3.0], 1.0)
    mechanism = lx.Mechanism([body], [lx.Spherical("ball", lx.GROUND, body)])
    turned = np.array([1.0, 0.5, -0.3, 0.2])
    state = lx.assemble(mechanism, {"ball": turned}, {"ball": [0.1, 0.2, 0.3]})
    np.testing.assert_allclose(state.q, turned / np.linalg.norm(turned), atol=1e-14)
    np.testing.assert_allclose(state.v, [0.1, 0.2, 0.3], atol=1e-14)
    state = lx.assemble(mechanism, speeds={("ball", 2): 0.5})
    np.testing.assert_allclose(state.v, [0.0, 0.0, 0.5], atol=1e-14)
    with pytest.raises(ValueError, match=r"position of joint 'ball': index 1 is part of a quaternion"):
        lx.assemble(mechanism, {("ball", 1): 0.1})
    with pytest.raises(ValueError, match=r"speed of joint 'ball': index 3; it has 3 speeds"):
        lx.assemble(mechanism, speeds={("ball", 3): 0.1})
    with pytest.raises(ValueError, match=r"position of joint 'ball' is one number; the joint has 4"):
        lx.assemble(mechanism, {"ball": 0.1})


def test_rods_that_cannot_make_a_triangle():
    near, far = lx.rod("near", 1.0, 1.0), lx.rod("far", 1.0, 1.0)
    joints = [
        lx.Revolute("left", lx.GROUND, near.at("base"), "z"),
        lx.Revolute("right", lx.GROUND.at([3.0, 0.0, 0.0]), far.at("base"), "z"),
        lx.Revolute("top", near.at("tip"), far.at("tip"), "z"),
    ]
    with pytest.raises(lx.AssemblyError, match=r"joint 'top' does not close: a gap of 1 m remains"):
        lx.assemble(lx.Mechanism([near, far], joints))


AXIAL_STIFFNESS = 1.4e7


def four_bar(length=0.8, ground=1.0, flexible=True):
    crank, rocker = lx.rod("crank", length=0.4, mass=1.0), lx.rod("rocker", length=0.9, mass=1.0)
    section = lx.Section(500.0, 0.5, AXIAL_STIFFNESS)
    beam = lx.Beam("coupler", length, section, elements=1, bends="z", torsion=False)
    coupler = beam if flexible else lx.rod("coupler", length=length, mass=1.0)
    hinge = lambda *ends, **options: lx.Revolute(*ends, axis="z", **options)
    joints = [
        hinge("A", lx.GROUND, crank.at("base")),
        hinge("B", crank.at("tip"), coupler.at("base")),
        hinge("C", coupler.at("tip"), rocker.at("base")),
        hinge("D", rocker.at("tip"), lx.GROUND.at([ground, 0.0, 0.0]), cut=True),
    ]
    return lx.Mechanism([crank, coupler, rocker], joints)


def assembled(length, guess, flexible=True):
    """Coordinates and speeds of the joints that a beam and a rod have in common, and strains of the beam."""
    mechanism = four_bar(length, flexible=flexible)
    state = lx.assemble(mechanism, speeds={"A": 1.0}, guess={"A": guess[0], "B": guess[1]})
    of = lambda name: [state.q[mechanism.topology.coordinates[name]], state.v[mechanism.topology.speeds[name]]]
    return jnp.concatenate([*of("A"), *of("B")]), jnp.concatenate(of("coupler")) if flexible else jnp.zeros(0)


GUESSES = np.array([[1.0, -0.3], [1.0, -0.55], [0.5, 0.2], [2.0, 2.0]])


@pytest.mark.parametrize("guess", [*GUESSES, [0.0, 0.0]])
def test_loops_close_with_beams_straight(guess):
    """From near and from bad guesses, the singular one too, where all is in one line."""
    np.testing.assert_allclose(assembled(0.8, guess)[1], 0.0, atol=1e-12)


def test_a_beam_that_the_loops_strain_is_named():
    """A four-bar that is too short by 1 cm; the energy is that of a bar stretched so, to one per cent."""
    with pytest.warns(lx.AssemblyWarning, match=r"beam 'coupler' is strained, with an energy of .* J") as warned:
        lx.assemble(four_bar(ground=2.11), speeds={"A": 0.0}, guess={"A": 0.3, "B": 0.2})
    energy = float(str(warned[0].message).split("energy of ")[1].split(" J")[0])
    np.testing.assert_allclose(energy, AXIAL_STIFFNESS * 0.01**2 / (2.0 * 0.8), rtol=0.01)


@pytest.mark.slow
def test_loops_with_a_beam_close_as_with_a_rod():
    """Coordinates, speeds, their derivatives by the length of the coupler and by the guess, in a batch of guesses."""

    def batch(flexible):
        both = lambda *numbers: 2 * (assembled(*numbers, flexible),)
        slopes = jax.jacfwd(both, (0, 1), has_aux=True)
        return jax.jit(jax.vmap(slopes, in_axes=(None, 0)))(0.8, GUESSES)

    (of_beam, of_strains), (beam, _) = batch(True)
    (of_rod, _), (rod, _) = batch(False)
    close = lambda found, known: np.testing.assert_allclose(found, known, atol=1e-9)
    close(beam, rod)
    for found, known, of_strain in zip(of_beam, of_rod, of_strains, strict=True):
        close(found, known)
        close(of_strain, 0.0)


def strained_energy(deflection):
    """Of a cantilever of length 2 and E I = 1, whose tip slides on a rail parallel to it, at a distance."""
    beam = lx.Beam("beam", 2.0, lx.Section(1.0, 3.0, 5e3), elements=1, bends="z", torsion=False)
    block, aside = lx.point_mass("block", 1.0), jnp.asarray(deflection) * np.array([0.0, 1.0, 0.0])
    joints = [
        lx.Fixed("clamp", lx.GROUND, beam),
        lx.Prismatic("rail", lx.GROUND.at(aside), block, axis="x"),
        lx.Revolute("pin", beam.at("tip"), block, axis="z"),
    ]
    mechanism = lx.Mechanism([beam, block], joints)
    return lx.Solution.of_state(mechanism, lx.assemble(mechanism)).potential_energy()[0]


@pytest.mark.slow
def test_beams_are_strained_with_the_least_energy():
    """3 E I w² / 2 L³ where deflections w are small; the derivative is the force, of large ones too."""
    at, step = jnp.array([0.01, 0.1, 0.2]), 1e-5
    energy = jax.jit(jax.vmap(strained_energy))
    force = jax.jit(jax.vmap(jax.grad(strained_energy)))(at)
    np.testing.assert_allclose(energy(at)[0], 3.0 * at[0] ** 2 / 16.0, rtol=1e-4)
    np.testing.assert_allclose(force, (energy(at + step) - energy(at - step)) / (2.0 * step), rtol=1e-6)


def test_in_a_batch_the_result_tells_of_a_state_that_was_not_found():
    """A crank of one metre that stands upright, and rods of which one is too short."""

    def reached(rod):
        mechanism = crank_slider(rod=rod)
        return lx.Solution.of_state(mechanism, lx.assemble(mechanism, {"bearing": 0.5 * np.pi})).result

    found = lx.sweep(lambda rod: {"result": reached(rod), "rod": rod}, jnp.array([1.3, 0.8, 1.1]), progress=False)
    assert found.count() == {"successful": 2, "not_assembled": 1}
    assert "cannot be closed" in found.failed[1]
