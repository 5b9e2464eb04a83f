"""Who waits is told why, where somebody watches."""

import sys
import time

import jax
import jax.numpy as jnp
import pytest

import linkax as lx
from linkax.xla import waiting
from linkax.xla.waiting import Progress, compiling

LINE = "linkax: compiling, "


@pytest.fixture
def watched(monkeypatch):
    monkeypatch.setattr(waiting, "is_watched", lambda: True)
    monkeypatch.setattr(waiting, "WORTH_TELLING", 0.0)


def shown(capsys):
    """The lines that came, one in place of the other; the last is empty."""
    *lines, last = capsys.readouterr().err.split("\r")
    assert last.strip() == ""
    return [line.rstrip() for line in lines if line.strip()]


def test_a_long_wait_is_told_in_one_line_that_vanishes(watched, capsys):
    with compiling(), compiling():
        time.sleep(0.2)
    (line,) = shown(capsys)
    assert line == "linkax: compiling, 0 s so far; later runs reuse it"
    with compiling(is_first=False):
        time.sleep(0.1)
    assert shown(capsys) == []


def test_a_short_wait_tells_nothing(watched, monkeypatch, capsys):
    monkeypatch.setattr(waiting, "WORTH_TELLING", 2.0)
    with compiling():
        time.sleep(0.1)
    assert capsys.readouterr().err == ""


def test_nothing_is_told_where_nobody_watches(monkeypatch, capsys):
    monkeypatch.setattr(waiting, "WORTH_TELLING", 0.0)
    assert not sys.stderr.isatty()
    with compiling():
        time.sleep(0.1)
    assert capsys.readouterr().err == ""


def waited_for():
    """A mechanism with a name of its own, so that no other test has compiled it."""
    arm = lx.rod("waited_for", 1.0, 1.0)
    return lx.Mechanism([arm], [lx.Revolute("hinge", lx.GROUND, arm.at("base"), "z")])


def test_an_assembly_that_compiles_for_the_first_time_is_told(watched, capsys):
    for told in (True, False):
        lx.assemble(waited_for(), {"hinge": 0.3})
        assert bool(shown(capsys)) is told


def test_a_run_that_compiles_for_the_first_time_is_told(watched, capsys):
    mechanism, start = waited_for(), lx.State(jnp.array([0.3]), jnp.zeros(1))
    run = lambda t1: lx.simulate(mechanism, start, t1=t1).reaction("hinge").force
    for told in (True, False):
        run(1.0)
        assert bool(shown(capsys)) is told
    jax.vmap(lambda t1: run(t1))(jnp.ones(2))
    assert shown(capsys) == []


def test_sweeps_and_fits_tell_how_far_they_are(watched, capsys):
    lx.sweep(lambda x: x**2, jnp.arange(5.0), chunk=5)
    assert any(line.startswith("linkax: sweeping, 5 of 5 members") for line in shown(capsys))
    lx.fit(lambda x: x - 3.0 * jnp.ones(2), 1.0)
    lines = shown(capsys)
    assert any(line.startswith("linkax: fitting, ") and "loss" in line for line in lines)
    lx.sweep(lambda x: x**2, jnp.arange(5.0), chunk=5, progress=False)
    assert not any("sweeping" in line for line in shown(capsys))


def test_progress_that_is_asked_for_comes_as_lines_where_nobody_watches(capsys):
    with Progress(3, "member", True) as line:
        for count in (1, 2, 3):
            line.tell("sweeping", count)
    assert capsys.readouterr().err.splitlines() == [
        "linkax: sweeping, 1 of 3 members, 0 s",
        "linkax: sweeping, 3 of 3 members, 0 s",
    ]
