"""The view, in a real browser, and the plots."""

import base64
import dataclasses
import io
import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import diffrax
import numpy as np
import pytest
import trimesh
from known_answers import start
from PIL import Image
from refusals import refused
from scipy.spatial.transform import Rotation

import linkax as lx
from linkax.scenery.scenery import scenery_of
from linkax.scenes import SCENES
from linkax.view.page import MOST_NUMBERS

# A browser without a graphics card computes its pictures on the processor.
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


@pytest.fixture(scope="module")
def browser():
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None and os.environ.get("CI") != "true":
        pytest.skip("no Chromium on this machine")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=found, args=FLAGS)
        yield started
        started.close()


def stewart_platform():
    """A platform on six legs that lengthen, with a universal joint below and a ball above each."""
    around = lambda radius, degrees: radius * np.stack([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])
    platform = lx.RigidBody("platform", 20.0, inertia=[1.0, 1.0, 2.0])
    bodies, joints = [platform], [lx.Free("pose", lx.GROUND, platform)]
    for leg, (below, above) in enumerate([(-10, -50), (10, 50), (110, 70), (130, 170), (230, 190), (250, 290)]):
        lower, upper = (lx.rod(f"{name}_{leg}", length=0.6, mass=1.0) for name in ("lower", "upper"))
        bodies += [lower, upper]
        foot, head = around(1.0, below), around(0.6, above)
        joints += [
            lx.Universal(f"foot_{leg}", lx.GROUND.at(foot), lower.at("base"), axis="z", second_axis="y"),
            lx.Prismatic(f"leg_{leg}", lower, upper, axis="x"),
            lx.Spherical(f"head_{leg}", upper.at("tip"), platform.at(head), cut=True),
        ]
    mechanism = lx.Mechanism(bodies, joints, [lx.Gravity([0.0, 0.0, -9.81])])
    guess = {f"foot_{leg}": [0.0, -1.4] for leg in range(6)}
    return mechanism, lx.assemble(mechanism, {"pose": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]}, guess=guess)


def swaying(mechanism, state, count=41):
    """A solution about a state, on the closed loops or not, which needs no simulation; a view shows any."""
    at_rest = lx.Solution.of_state(mechanism, state)
    ts, far = np.linspace(0.0, 2.0, count), np.linspace(0.02, 0.2, len(state.q))
    q = np.asarray(state.q) + np.sin(2.0 * ts)[:, None] * far
    for begin, _ in mechanism.topology.quaternions:
        q[:, begin : begin + 4] /= np.linalg.norm(q[:, begin : begin + 4], axis=1, keepdims=True)
    return dataclasses.replace(at_rest, ts=ts, q=q, v=np.zeros((count, len(state.v))))


def scene(name):
    return *start(name), SCENES[name].points(SCENES[name].settings())


@pytest.fixture(scope="module")
def crank_slider():
    mechanism, state, points = scene("crank-slider")
    solution = lx.simulate(mechanism, state, t1=2.0, saveat=diffrax.SaveAt(ts=np.linspace(0.0, 2.0, 41)))
    return solution, points


def opened(browser, view, path):
    page = browser.new_page(viewport={"width": 700, "height": 480})
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda request: errors.append(request.url) if not request.url.startswith("file:") else None)
    page.goto(view.save(path / "view.html").as_uri())
    page.wait_for_function("window.linkax !== undefined", timeout=30_000)
    return SimpleNamespace(page=page, errors=errors, ask=page.evaluate)


def drag_time(page, time):
    """Move the slider as a hand does."""
    page.locator("#time").evaluate("(slider, t) => {slider.value = t; slider.dispatchEvent(new Event('input'))}", time)


def assert_shows(shown, solution):
    """Named bodies are where the solution says, at saved times."""
    poses = solution.poses()
    for index in (0, len(solution.ts) // 3, len(solution.ts) - 1):
        drag_time(shown.page, float(solution.ts[index]))
        for name, (origin, axes) in poses.items():
            place, turn = shown.ask(f"[linkax.position('{name}'), linkax.quaternion('{name}')]")
            np.testing.assert_allclose(place, origin[index], atol=1e-6)
            np.testing.assert_allclose(Rotation.from_quat(turn).as_matrix(), axes[index], atol=1e-6)
    assert not shown.errors


def picture(shown):
    shown.page.wait_for_timeout(200)
    return np.asarray(Image.open(io.BytesIO(shown.page.locator("canvas").screenshot())).convert("RGB"), float)


def test_crank_slider_renders_plays_and_tells_names(browser, crank_slider, tmp_path):
    solution, points = crank_slider
    shown = opened(browser, solution.view(points=points, reactions=["guide"]), tmp_path)
    shown.page.wait_for_function("linkax.playing() && linkax.time() > 0.0", timeout=20_000)
    assert_shows(shown, solution)
    drag_time(shown.page, 0.0)
    first = picture(shown)
    drag_time(shown.page, 0.5)
    assert np.sum(np.abs(first - picture(shown)) > 30.0) > 500
    shown.ask("linkax.seek(0.2)")
    shown.page.keyboard.press("Space")
    shown.page.wait_for_function("linkax.time() > 0.6", timeout=20_000)
    shown.page.locator("#play").click()
    assert not shown.ask("linkax.playing()")
    shown.ask("linkax.seek(0.5)")
    index = int(np.argmin(np.abs(np.asarray(solution.ts) - 0.5)))
    tip, slider = (np.asarray(solution.position(*point))[index] for point in (("crank", "tip"), ("slider", None)))
    pull = np.asarray(solution.reaction("guide").force)[index]
    force = np.linalg.norm(pull)
    told = {
        "crank: body, 1 kg": tip / 2,
        "crank_pin: Revolute": tip,
        "wrist_pin: Revolute": slider,
        f"guide: force on slider, {float(force):#.4g} N": slider + 0.25 * np.eye(3)[1] * np.sign(pull[1]),
    }
    for label, place in told.items():
        shown.page.mouse.move(*shown.ask(f"linkax.pixel({np.asarray(place).tolist()})"))
        assert shown.page.locator("#tip").text_content() == label


@pytest.mark.parametrize("name", ["bricard", pytest.param("stewart", marks=pytest.mark.slow)])
def test_bodies_are_where_the_solution_says(name, browser, tmp_path):
    mechanism, state, points = (*stewart_platform(), {}) if name == "stewart" else scene(name)
    solution = swaying(mechanism, state)
    shown = opened(browser, solution.view(points=points), tmp_path)
    assert_shows(shown, solution)
    assert np.std(picture(shown)) > 5.0


@pytest.mark.slow
def test_telescopic_crane_fits_into_a_file(browser, tmp_path):
    mechanism, state, points = scene("telescopic-crane")
    solution = swaying(mechanism, state, count=2001)
    shown = opened(browser, solution.view(tmp_path / "crane.html", points=points), tmp_path)
    assert (tmp_path / "crane.html").stat().st_size < 5e6
    stride = -(-7 * len(mechanism.bodies) * len(solution.ts) // MOST_NUMBERS)
    assert stride > 1
    thinned = {name: np.asarray(getattr(solution, name))[::stride] for name in ("ts", "q", "v")}
    assert_shows(shown, dataclasses.replace(solution, **thinned))


def test_one_state_is_shown_without_time(browser, crank_slider, tmp_path):
    solution, _ = crank_slider
    view = solution.mechanism.view(solution.end, tmp_path / "state.html")
    shown = opened(browser, view, tmp_path)
    assert shown.page.locator("#play").is_disabled()
    assert not shown.ask("linkax.playing()")
    end = solution.position("slider")[-1]
    np.testing.assert_allclose(shown.ask("linkax.position('slider')"), end, atol=1e-6)
    assert (tmp_path / "state.html").read_text() == view.html


def test_bodies_are_drawn_as_their_shapes(browser, tmp_path):
    """A box and a mesh of a file, which turn with their body and tell its name, in their own colours."""
    corners = np.array([[0.0, -0.2, 0.0], [1.0, -0.2, 0.0], [0.5, -0.2, 1.0], [0.5, 0.4, 0.4]])
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]).export(tmp_path / "part.stl")
    shapes = [
        lx.Shape("box", [0.6, 0.4, 0.2], [-0.5, 0.0, 0.0], colour=[0.9, 0.0, 0.0, 1.0]),
        lx.Shape("mesh", position=[0.5, 0.0, 0.0], mesh=tmp_path / "part.stl", colour=[0.0, 0.7, 0.0, 1.0]),
    ]
    arm = lx.RigidBody("arm", 2.0, inertia=[0.1, 0.1, 0.1], shape=shapes)
    hinge = lx.Revolute("hinge", lx.GROUND, arm, axis="y")
    mechanism = lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, 0.0, -9.81])])
    shown = opened(browser, mechanism.view(lx.State(np.array([np.pi]), np.zeros(1))), tmp_path)
    seen = picture(shown)
    for place, channel in (([0.5, 0.0, 0.0], 0), ([-1.0, 0.0, -0.4], 1)):  # after half a turn about y
        x, y = shown.ask(f"linkax.pixel({place})")
        red_green_blue = seen[round(y), round(x)]
        assert np.argmax(red_green_blue) == channel
        assert red_green_blue[channel] > 2.0 * np.delete(red_green_blue, channel).max()
        shown.page.mouse.move(x, y)
        assert shown.page.locator("#tip").text_content() == "arm: body, 2 kg"
    assert not shown.errors


def test_a_notebook_shows_the_page_in_a_frame(browser, crank_slider, tmp_path):
    view = crank_slider[0].view()
    (tmp_path / "cell.html").write_text(f"<!doctype html><body>{view._repr_html_()}</body>")
    page = browser.new_page()
    page.goto((tmp_path / "cell.html").as_uri())
    page.frame_locator("iframe").locator("canvas").wait_for(timeout=30_000)


def test_bad_requests(crank_slider):
    solution, _ = crank_slider
    with pytest.raises(ValueError, match="unknown joint 'hinge'; known: 'bearing'"):
        solution.view(reactions=["hinge"])
    with pytest.raises(ValueError, match="unknown body 'wheel'"):
        solution.view(points={"rim": ("wheel", None)})
    form = "give {name: (body, at)}"
    refused(lambda: solution.view(points=["rod"]), "points is ['rod']", form)
    for entry in ([0.1, 0.2, 0.0], "rod", ("rod",), (0.3, "rod")):
        refused(lambda entry=entry: solution.view(points={"P": entry}), f"points: 'P' is {entry!r}", form)
    batch = dataclasses.replace(solution, ts=np.stack([solution.ts] * 2))
    with pytest.raises(ValueError, match=r"is a batch of shape \(2,\); draw one of its members"):
        batch.view()


@pytest.mark.parametrize("opens", [True, False])
def test_where_no_browser_opens_the_path_is_told(opens, crank_slider, monkeypatch, capsys):
    monkeypatch.setattr("webbrowser.open", lambda _: opens)
    crank_slider[0].view().show()
    told = capsys.readouterr().err
    assert opens == (told == "")
    if not opens:
        assert "showMechanism" in Path(re.search(r"the page is (.+)", told)[1]).read_text()


def labels(figure):
    return [panel.get_ylabel() for panel in figure.axes]


def test_plots_show_what_the_solution_says(crank_slider):
    solution, _ = crank_slider
    motion = lx.plot.motion(solution, "slider")
    assert labels(motion) == ["position [m]", "velocity [m/s]", "acceleration [m/s²]"]
    (line,) = motion.axes[0].lines  # along x alone
    np.testing.assert_array_equal(line.get_ydata(), solution.position("slider")[:, 0])
    joint = lx.plot.joint(solution, "guide")
    assert labels(joint) == ["coordinate\n[m]", "speed\n[m/s]"]
    np.testing.assert_array_equal(joint.axes[1].lines[0].get_ydata(), solution.joint_speed("guide"))
    assert Image.open(io.BytesIO(joint._repr_png_())).size == (700, 500)  # which a notebook shows
    energy = lx.plot.energy(solution)
    np.testing.assert_allclose(energy.axes[0].lines[-1].get_ydata(), solution.energy())
    assert len(lx.plot.violations(solution).axes) == 3
    distance = lx.plot.singularity(solution).axes[0].lines[0]
    np.testing.assert_array_equal(distance.get_ydata(), solution.singularity_distance())
    with pytest.raises(ValueError, match="unknown joint 'hinge'"):
        lx.plot.joint(solution, "hinge")
    batch = dataclasses.replace(solution, ts=np.stack([solution.ts] * 2))
    with pytest.raises(ValueError, match="draw one of its members"):
        lx.plot.energy(batch)


def test_a_notebook_shows_the_animation_that_is_written(crank_slider, tmp_path):
    solution, points = crank_slider
    film = lx.plot.animate(solution, tmp_path / "film.gif", points, dpi=20)
    (shown,) = re.fullmatch('<img src="data:image/gif;base64,(.*)">', film._repr_html_()).groups()
    assert (tmp_path / "film.gif").read_bytes() == film.gif == base64.b64decode(shown)
    with Image.open(io.BytesIO(film.gif)) as opened:
        assert (opened.format, opened.is_animated) == ("GIF", True)
    at_end = lx.Solution.of_state(solution.mechanism, solution.end)
    with pytest.raises(ValueError, match="a solution of 1 times cannot be animated"):
        lx.plot.animate(at_end)


@pytest.mark.slow
def test_reactions_that_are_not_unique_are_hatched(crank_slider):
    solution, _ = crank_slider
    assert not lx.plot.reaction(solution, "guide").axes[0].collections
    door = lx.box("door", [1.0, 0.05, 2.0], mass=20.0)
    places = {"lower": [-0.5, 0.0, -0.8], "upper": [-0.5, 0.0, 0.8]}
    hinges = [lx.Revolute(name, lx.GROUND.at(place), door.at(place), axis="z") for name, place in places.items()]
    on_two_hinges = lx.Mechanism([door], hinges, [lx.Gravity([0.0, 0.0, -9.81])])
    figure = lx.plot.reaction(lx.Solution.of_state(on_two_hinges, lx.assemble(on_two_hinges)), "lower")
    assert labels(figure)[0] == "force [N]"
    (hatched,) = figure.axes[0].collections
    assert hatched.get_hatch() == "////"


def test_paths_are_drawn_in_the_plane_to_scale(crank_slider):
    solution, _ = crank_slider
    (panel,) = lx.plot.path(solution, {"pin": ("crank", "tip"), "wrist": ("slider", None)}).axes
    assert (panel.get_xlabel(), panel.get_ylabel(), panel.get_aspect()) == ("x [m]", "y [m]", 1.0)
    paths = {line.get_label(): line.get_xydata() for line in panel.lines}
    pin = np.asarray(solution.position("crank", "tip"))
    np.testing.assert_allclose(paths["pin"][[0, -1]], pin[[0, -1], :2], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(paths["pin"], axis=1), np.linalg.norm(pin[0]), rtol=1e-3)  # a circle
    np.testing.assert_allclose(paths["wrist"][:, 1], 0.0, atol=1e-12)  # a line along x
    assert panel.get_title() == "Path of pin, wrist"
    refused(lambda: lx.plot.path(solution, {}), "points is {}", "at least one")
    refused(lambda: lx.plot.path(solution, ("crank", "tip")), "points is ('crank', 'tip')", "{name: (body, at)}")


def test_paths_in_space_are_seen_from_a_corner():
    mechanism, state, points = scene("bricard")
    solution = swaying(mechanism, state)
    (panel,) = lx.plot.path(solution, points).axes
    (name, point), *_ = points.items()
    seen = scenery_of(solution, points).camera.seen(np.asarray(solution.position(*point)))
    (path,) = (line.get_xydata() for line in panel.lines if line.get_label() == name)
    np.testing.assert_allclose(path[[0, -1]], seen[[0, -1]], atol=1e-12)
    assert not panel.axison


@pytest.mark.parametrize(
    ("at", "name", "title"),
    [
        (None, None, "Motion of slider's centre of mass along x"),
        ([0.1, 0.2, 0.0], None, "Motion of slider at (0.1, 0.2, 0) m along x"),
        (None, "pin", "Motion of pin along x"),
    ],
)
def test_titles_of_motions_tell_the_point(at, name, title, crank_slider):
    assert lx.plot.motion(crank_slider[0], "slider", at, name).axes[0].get_title() == title


@pytest.mark.slow
def test_the_reaction_of_a_drive_is_its_torque_or_force():
    arm, load = lx.rod("arm", 1.0, 2.0), lx.point_mass("load", 3.0)
    joints = [lx.Revolute("hinge", lx.GROUND, arm.at("base"), "z"), lx.Prismatic("lift", lx.GROUND, load, "y")]
    drives = [lx.Drive("motor", "hinge", speed=0.0), lx.Drive("winch", "lift", speed=0.0)]
    mechanism = lx.Mechanism([arm, load], joints, [lx.Gravity([0.0, -9.81, 0.0])], drives)
    here = lx.Solution.of_state(mechanism, lx.assemble(mechanism))
    for name, label, value in (("motor", "torque [N m]", 9.81), ("winch", "force [N]", 3.0 * 9.81)):
        (panel,) = lx.plot.reaction(here, name).axes
        assert (panel.get_title(), panel.get_ylabel()) == (f"Reaction of drive {name!r}", label)
        np.testing.assert_allclose(panel.lines[0].get_ydata(), [value], rtol=1e-12)
        assert not panel.collections
    np.testing.assert_allclose(here.reaction("hinge").moment, 0.0, atol=1e-12)  # as the motor bears it
    twice = [*drives, lx.Coupling("brake", {"lift": 2.0})]
    again = lx.Mechanism([arm, load], joints, mechanism.forces, twice)
    (panel,) = lx.plot.reaction(lx.Solution.of_state(again, lx.assemble(mechanism)), "brake").axes
    assert panel.get_ylabel() == "multiplier"
    assert panel.collections[0].get_hatch() == "////"
    with pytest.raises(
        ValueError, match="unknown joint or constraint 'engine'; known: 'hinge', 'lift', 'motor', 'winch'"
    ):
        lx.plot.reaction(here, "engine")


@pytest.mark.parametrize("name", ["bricard", pytest.param("stewart", marks=pytest.mark.slow)])
def test_spatial_mechanisms_are_seen_from_a_corner(name):
    """No rod points at the eye."""
    mechanism, state, points = (*stewart_platform(), {}) if name == "stewart" else scene(name)
    seen = scenery_of(swaying(mechanism, state), points)
    assert seen.camera.plane is None
    np.testing.assert_allclose(np.linalg.det(np.stack(seen.camera[:3])), 1.0, atol=1e-12)
    for name, outline in seen.outlines.items():
        length = np.ptp(np.stack([seen.seen(name, mark)[0] for mark in outline]), axis=0)
        assert len(outline) < 2 or np.linalg.norm(length) > 0.1


def test_planar_motion_is_seen_in_its_plane_unless_from_above(crank_slider):
    assert scenery_of(crank_slider[0], {}).camera.plane == (0, 1)
    door = lx.box("door", [1.0, 0.05, 2.0], mass=20.0)
    hinge = lx.Revolute("hinge", lx.GROUND, door.at([-0.5, 0.0, 0.0]), axis="z")
    for gravity, plane in ([0.0, 0.0, -9.81], None), ([0.0, 0.0, 0.0], (0, 1)):
        mechanism = lx.Mechanism([door], [hinge], [lx.Gravity(gravity)])
        turning = swaying(mechanism, lx.State(np.zeros(1), np.zeros(1)))
        assert scenery_of(turning, {}).camera.plane == plane
