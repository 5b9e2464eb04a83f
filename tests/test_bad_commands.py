"""Any command line with one thing wrong ends with code 2 and one line that names it, and leaves no file."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from linkax.formulations.named import COMPARED
from linkax.scenes import SCENES
from linkax_command import run
from linkax_command.parser import EQUAL, PRESETS, SOLVERS

texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8)
NO_SIZE = ["", "0", "-1", "nan", "inf", "-inf", "1e999", "1,5", "0x10", "one", "1e", "None", "[1]", "1j"]
NO_NUMBER = [text for text in NO_SIZE if text not in ("0", "-1")]


def not_one_of(choices):
    known = {choice.lower() for choice in choices}
    return texts.filter(lambda text: text == text.strip() and text.lower() not in known)


# What each option does not take.
OPTIONS = {
    "--t1": st.sampled_from(NO_SIZE),
    "--rtol": st.sampled_from(NO_SIZE),
    "--dt": st.sampled_from(NO_SIZE),
    "--preset": not_one_of(PRESETS),
    "--solver": not_one_of(SOLVERS),
    "--variant": not_one_of([name for scene in SCENES.values() for name in scene.variants]),
}
OF_COMMAND = {
    "simulate": {"--formulation": not_one_of(COMPARED).filter(lambda text: "+" not in text)},
    "compare": {
        "--formulations": not_one_of(COMPARED).filter(lambda text: "+" not in text and "," not in text),
        "--equal": not_one_of(EQUAL),
        "--bound": st.sampled_from(NO_SIZE),
    },
}


def refused(arguments, capsys, folder, *words):
    """Run a command line, and check that it is refused."""
    before = sorted(folder.rglob("*"))
    capsys.readouterr()
    assert run([*arguments, "--no-plots"]) == 2, arguments
    printed = capsys.readouterr()
    assert printed.out == ""
    *progress, line = printed.err.splitlines()
    assert line.startswith("linkax: ")
    assert progress in ([], ["assembling ..."])
    for word in words:
        assert " ".join(word.split()) in line, (arguments, line)
    assert sorted(folder.rglob("*")) == before, "files were left"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("command", "option"),
    [(command, option) for command, own in OF_COMMAND.items() for option in OPTIONS | own],
)
def test_a_bad_value_of_an_option_is_named(command, option, capsys, folder):
    @given(
        scene=st.sampled_from(["pendulum", "crank-slider", "n-four-bar"]), value=(OPTIONS | OF_COMMAND[command])[option]
    )
    def check(scene, value):
        refused([command, scene, f"{option}={value}"], capsys, folder, repr(value))

    check()


@pytest.mark.parametrize("command", OF_COMMAND)
def test_a_bad_parameter_is_named(command, capsys, folder):
    @given(scene=st.sampled_from(sorted(SCENES)), data=st.data())
    def check(scene, data):
        known = data.draw(st.sampled_from(sorted(SCENES[scene].parameters)))
        unknown = data.draw(not_one_of(SCENES[scene].parameters).filter(lambda text: "=" not in text))
        value = data.draw(st.sampled_from([*NO_NUMBER, "1.0.0"]))
        wrong = (f"{known}={value}", (repr(known), repr(value))), (f"{unknown}=1", ("no parameter",))
        change, words = data.draw(st.sampled_from([*wrong, (known, ("NAME=VALUE",))]))
        refused([command, scene, f"--set={change}"], capsys, folder, *words)

    check()


@pytest.mark.parametrize("command", OF_COMMAND)
def test_an_unknown_scene_option_or_command_is_named(command, capsys, folder):
    @given(name=not_one_of(SCENES).filter(lambda text: not text.startswith("-")))
    def check(name):
        refused([command, name], capsys, folder, repr(name))
        refused([command, "pendulum", f"--{'x' + name}=1"], capsys, folder, f"--x{name}")

    check()


PLACES = {
    "a file": lambda folder: folder / "there",
    "below a file": lambda folder: folder / "there" / "more",
    "where nothing can be written": lambda folder: Path("/proc"),
    "below it": lambda folder: Path("/proc/linkax"),
    "no path": lambda folder: "a\0b",
    "nothing": lambda folder: "",
}


@pytest.mark.parametrize("command", OF_COMMAND)
@pytest.mark.parametrize("case", PLACES)
def test_a_folder_that_cannot_be_written_is_named_before_the_run(command, case, capsys, folder, monkeypatch):
    (folder / "there").write_text("kept")
    out = PLACES[case](folder)
    if str(out).startswith("/proc") and not Path("/proc/self").exists():
        pytest.skip("no /proc")
    never = lambda *arguments: pytest.fail("assembled before the folder was tried")
    monkeypatch.setattr("linkax.cli.options.RunOptions.initial", never)
    refused([command, "pendulum", f"--out={out}"], capsys, folder, "--out")
    assert (folder / "there").read_text() == "kept"
