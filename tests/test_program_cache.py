"""Compiled programs on disk, in processes of their own."""

import functools
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from enum import IntEnum
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from jax.experimental.compilation_cache import compilation_cache
from mechanisms import crank_slider

import linkax as lx
from linkax.model.functions import Function
from linkax.xla import program_cache
from linkax.xla.users_line import warn
from scalarjit import keep_in, kept_programs, scalarised, with_known_entries
from scalarjit.descriptions import Undescribed, description

SOURCE = Path(lx.__file__).parents[1]
SETTINGS = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "EQX_ON_ERROR")
TOLD = """
import json, os, sys
import jax, jax.numpy as jnp, numpy as np
import linkax as lx
from scalarjit import scalarised

traced, asked, found = [], [], []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, **what: traced.append(what["fun_name"]) if event.endswith("jaxpr_trace_duration") else None
)
events = {"compile_requests_use_cache": asked, "cache_hits": found}
jax.monitoring.register_event_listener(lambda event, **_: events.get(event.rpartition("/")[2], []).append(event))
folder = lx.cache_programs(*sys.argv[1:])
"""
PENDULUM = (
    TOLD
    + """
rate, own = float(os.environ.get("RATE", "1.0")), lambda t: rate * np.pi * t
arm = lx.rod("arm", 1.0, 1.0)
hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), "z")
forces = [lx.Gravity([0.0, -9.81, 0.0]), lx.JointTorque("hinge", lambda t, motion: jnp.sin(own(t)))]
mechanism = lx.Mechanism([arm], [hinge], forces)
solution = lx.simulate(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1)), t1=1.0)
force = solution.reaction("hinge").force[-1].tolist()
names = ("_check_start", "_closed", "_integrate", "_of_times")
programs = [name for name in names if any(program.startswith(name) for program in traced)]
print(json.dumps([force, programs, len(asked), len(found), folder]))
"""
)
EIGENVALUES = (
    TOLD
    + """

def values_of(matrix):
    return jnp.linalg.eigvalsh(matrix @ matrix.T)

values = scalarised(values_of)(np.eye(40) + 0.1 * np.arange(40.0)[:, None])
print(json.dumps([values.tolist(), any(program.startswith("values_of") for program in traced)]))
"""
)


def programs_in(folder):
    """Files of programs, beside which there are those of object code."""
    return [file for file in folder.glob("*") if file.suffix != ".o"]


def ran(*arguments, program=PENDULUM, **environment):
    """What the program prints at last, and what it warns of."""
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS} | environment
    command = [sys.executable, "-c", program, *map(str, arguments)]
    found = subprocess.run(command, capture_output=True, text=True, env=environment | {"PYTHONPATH": str(SOURCE)})
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout.splitlines()[-1]), found.stderr


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A folder, and what the first process with it prints."""
    folder = tmp_path_factory.mktemp("programs")
    return folder, ran(folder)[0]


@pytest.mark.users_settings
def test_a_second_process_traces_and_compiles_nothing(first):
    """With functions of a user, which may hash otherwise there."""
    path, (force, programs, asked, found, folder) = first
    assert (programs, found, folder) == (["_check_start", "_closed", "_integrate", "_of_times"], 0, str(path))
    assert asked > 3
    again, told = ran(JAX_COMPILATION_CACHE_DIR=str(path), PYTHONHASHSEED="1")
    assert (again[0], again[1], again[4]) == (force, [], str(path))
    assert again[2] == again[3]
    assert "compiled again" not in told


@pytest.mark.slow
def test_another_number_in_a_function_of_a_user_is_another_program(first):
    path, (force, *_) = first
    other, _ = ran(path, RATE="2.0")
    assert other[0] != force
    assert "_integrate" in other[1]


@pytest.mark.slow
def test_kept_programs_call_lapack(tmp_path):
    """Which JAX loads where it lowers, as it does not here; and a file that is damaged is none."""
    matrix = np.eye(40) + 0.1 * np.arange(40.0)[:, None]
    for traces in (True, False, True, False):
        (found, traced), _ = ran(tmp_path, program=EIGENVALUES)
        np.testing.assert_allclose(found, np.linalg.eigvalsh(matrix @ matrix.T), rtol=1e-12)
        assert traced == traces
        (file,) = programs_in(tmp_path / "linkax")
        if not traces:
            text = bytearray(file.read_bytes())
            text[len(text) // 2] ^= 1
            file.write_bytes(text)


@pytest.fixture
def kept_in(tmp_path):
    """A folder for programs of this process, of which it forgets all afterwards; JAX keeps and finds none."""
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()  # which is open where tests keep theirs
    keep_in(tmp_path / "linkax")
    yield tmp_path / "linkax"
    kept_programs._met.clear()


def test_programs_are_kept_by_their_kind(kept_in):
    calls = []

    def twice(numbers, more=1):
        calls.append(numbers.shape)
        return {"twice": 2.0 * numbers, "more": more}

    program = scalarised(twice)
    program.lower(np.ones(3)).compile()
    blank = program.blank_result(np.ones(3))
    np.testing.assert_array_equal(blank["twice"], np.zeros(3))
    assert blank["more"] == 1
    assert len(calls) == len(programs_in(kept_in)) == 1
    np.testing.assert_array_equal(program(jnp.arange(3.0))["twice"], [0.0, 2.0, 4.0])
    assert len(calls) == 1
    assert program(np.ones(3), more=2)["more"] == 2
    assert program(np.ones(4))["twice"].shape == (4,)
    assert jax.jit(program)(np.ones(5))["twice"].shape == (5,)  # within another program
    assert len(programs_in(kept_in)) == 3
    kept_programs._met.clear()  # as another process
    assert program(np.ones(3), more=2)["more"] == 2
    assert len(calls) == 4


def test_what_jax_found_is_not_written(kept_in, monkeypatch):
    """It would not run."""
    compile = jax.stages.Lowered.compile

    def found(lowered):
        jax.monitoring.record_event(kept_programs.FOUND)
        return compile(lowered)

    monkeypatch.setattr(jax.stages.Lowered, "compile", found)
    np.testing.assert_array_equal(scalarised(lambda numbers: 2.0 * numbers)(np.ones(3)), 2.0 * np.ones(3))
    assert not programs_in(kept_in)


def test_what_calls_back_to_python_is_not_written(kept_in):
    doubled = lambda numbers: jax.pure_callback(lambda given: 2.0 * np.asarray(given), numbers, numbers)
    np.testing.assert_array_equal(scalarised(doubled)(np.ones(3)), 2.0 * np.ones(3))
    assert not programs_in(kept_in)


class Mine(eqx.Module):
    number: float = 1.0


class Count(IntEnum):
    one = 1


class Length(float):
    pass


class Lengths(np.ndarray):
    pass


made: dict = {"__name__": "linkax"}
exec("class Made:\n    pass\n\ndef doubled(t):\n    return 2.0 * t", made)
doubled, partly = made["doubled"], functools.partial(jnp.dot, Mine())
THINGS = [
    Mine(), Mine, Count.one, Length(1.0), np.ones(2).view(Lengths), made["Made"], made["Made"](),
    functools.partial(lambda: 1), object(), compilations,
]  # fmt: skip
LAWS = [
    lambda t: Mine(t).number, lambda t: Count.one * t, lambda t: doubled(t), lambda t: partly(t),
    lambda t: jnp.interp(t, *np.loadtxt("profile.csv")), lambda t: t * float(os.environ.get("RATE", "1")),
    lambda t: t * np.random.normal(), lambda t: t * len(pytest.__name__),
]  # fmt: skip


@pytest.mark.parametrize("own", [*THINGS, *map(Function, LAWS)])
def test_what_may_change_is_not_described(own):
    """A name may stay where what it means changes, and so may what is outside of a program."""
    with pytest.raises(Undescribed):
        description(jax.tree.structure(own) if isinstance(own, Function) else own)


def test_functions_of_a_user_are_described_by_what_they_compute():
    def law(factor, offsets=(0.0,), power=2):
        own = lambda t: t**power
        return lambda t: factor * own(t) + offsets[0]

    described = lambda *args: description(jax.tree.structure(Function(law(*args))))
    alike = [(1.0,), (1.0, (0.0,)), (1.0, (0.0,), 2)]
    assert len({described(*args) for args in alike}) == 1
    others = [(2.0,), (1,), (np.float32(1.0),), (1.0, [0.0]), (1.0, (-0.0,)), (1.0, (0.0,), 3)]
    assert len({described(*args) for args in (*alike, *others)}) == 1 + len(others)


def test_equal_things_are_described_alike():
    described = lambda **changes: description(jax.tree.structure(with_known_entries(crank_slider(**changes))))
    assert described() == described()
    assert described(rod=1.4) == described()  # a number, which programs are given
    assert described(cut="guide") != described()
    for one, other in ((1, 1.0), (0.0, -0.0), ((1,), [1]), ({"a": 1}, {"b": 1}), (np.zeros(2), np.zeros((2, 1)))):
        assert description(one) == description(one)
        assert description(one) != description(other)
    assert description(diffrax.Dopri8()) == description(diffrax.Dopri8()) != description(diffrax.Dopri5())


def test_the_default_folder_is_the_users(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert program_cache.users_folder() == tmp_path / "linkax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert program_cache.users_folder() == Path.home() / ".cache" / "linkax"


def test_what_cannot_be_kept_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr(program_cache, "_warn", program_cache._warn.__wrapped__)  # not once only
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    program_cache._note(program_cache.ASKED)
    with pytest.warns(UserWarning, match="keeps none that calls back to Python") as told:
        program_cache._tell(program_cache.COMPILING, 3.0)
    assert told[0].filename == __file__
    for event in program_cache.FOUND_OR_KEPT:
        program_cache._note(program_cache.ASKED)
        program_cache._note(event)
        program_cache._tell(program_cache.COMPILING, 3.0)
    jax.config.update("jax_compilation_cache_dir", None)
    program_cache._note(program_cache.ASKED)
    program_cache._tell(program_cache.COMPILING, 3.0)


def test_warnings_point_to_the_users_line():
    """From below other libraries, and from a thread of linkax while the main thread waits."""
    with pytest.warns(DeprecationWarning, match="rank_tolerance") as below:
        lx.Accuracy(rank_tolerance=1e-9)
    with ThreadPoolExecutor() as threads, pytest.warns(UserWarning, match="of a thread") as in_thread:
        threads.submit(warn, "of a thread").result()
    assert [told.filename for told in (*below, *in_thread)] == [__file__, __file__]


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("kept")
    for folder in (tmp_path / "file", tmp_path / "file" / "below", "a\0b"):
        with pytest.raises(ValueError, match=r"cannot write to folder .*give another folder for programs"):
            lx.cache_programs(folder)
