"""Broken files of machines: a named error with the line, nothing read outside, nothing that hangs."""

import random
import re
import time
from pathlib import Path

import pytest

import linkax as lx

MACHINES = Path(__file__).parents[1] / "data" / "machines"
URDF = """<robot name="crank">
  <link name="frame"/>
  <link name="crank"><inertial><origin xyz="0 0 0.5" rpy="0 0 0"/><mass value="1"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.01"/></inertial></link>
  <link name="rod"><inertial><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
  <joint name="bearing" type="revolute"><parent link="frame"/><child link="crank"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><dynamics damping="0.1"/></joint>
  <joint name="pin" type="continuous"><parent link="crank"/><child link="rod"/><origin xyz="0 0 1"/>
    <axis xyz="0 1 0"/></joint>
  <loop name="slide" type="prismatic"><predecessor link="frame"/>
    <successor link="rod"><origin xyz="0 0 -1"/></successor><axis xyz="0 0 1"/></loop>
</robot>
"""
TEXTS = {
    ".sdf": (MACHINES / "cassie_v2.sdf").read_text(),
    ".xml": (MACHINES / "xarm7_gripper.xml").read_text(),
    ".urdf": URDF,
}
ENTITIES = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))


def cut_off(text, chance):
    return text[: chance.randrange(len(text))]


def wrong_number(text, chance):
    numbers = list(re.finditer(r"-?\d+\.\d+", text))
    place = chance.choice(numbers)
    return (
        text[: place.start()] + chance.choice(("nan", "inf", "1e999", "1,5", "", "--1", "0x1p3")) + text[place.end() :]
    )


def lost_attribute(text, chance):
    place = chance.choice(list(re.finditer(r' \w+="[^"]*"', text)))
    return text[: place.start()] + text[place.end() :]


def lost_tag(text, chance):
    place = chance.choice(list(re.finditer(r"<[^>]*>", text)))
    return text[: place.start()] + text[place.end() :]


def other_name(text, chance):
    names = re.findall(r'name="([^"]+)"', text)
    first, second = chance.choice(names), chance.choice(names)
    return text.replace(f'"{first}"', f'"{second}"').replace(f">{first}<", f">{second}<")


def with_entity(text, chance):
    root = re.search(r"<(sdf|mujoco|robot)", text).group(1)
    declared = chance.choice((f'<!ENTITY a0 "x">{ENTITIES}', '<!ENTITY a11 SYSTEM "file:///etc/passwd">'))
    return f"<!DOCTYPE {root} [{declared}]>" + text[text.index(f"<{root}") :].replace("name=", 'note="&a11;" name=', 1)


def noise(text, chance):
    place = chance.randrange(len(text))
    return text[:place] + "".join(chance.choices("\x00\x07<>&\"'é\ufffe", k=5)) + text[place:]


def error_of(path):
    """What loading a file says, or nothing where it is still a machine."""
    try:
        lx.load(path)
    except lx.MachineFileError as error:
        return str(error)
    return ""


WAYS = (cut_off, wrong_number, lost_attribute, lost_tag, other_name, with_entity, noise)


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_a_broken_file_loads_or_is_refused_by_name(way, tmp_path):
    """Thirty files of each kind; what is still a machine may load."""
    chance, refused = random.Random(way.__name__), 0
    for count in range(30):
        suffix = chance.choice(sorted(TEXTS))
        path = tmp_path / f"broken{count}{suffix}"
        path.write_text(way(TEXTS[suffix], chance), errors="surrogatepass")
        begun = time.monotonic()
        told = error_of(path)
        assert time.monotonic() - begun < 5.0
        assert not told or re.match(rf"{path.name}(:\d+: |.*line \d+|.*no body)", told, re.DOTALL), told
        refused += bool(told)
    assert refused >= (30 if way in (cut_off, with_entity) else 5)


def test_files_that_are_huge_deep_or_missing(tmp_path):
    path = tmp_path / "machine.sdf"
    path.write_text("<sdf>" + "<a>" * 300)
    with pytest.raises(lx.MachineFileError, match=r"machine.sdf:1: more than .* inside each other"):
        lx.load(path)
    with open(path, "wb") as file:
        file.truncate(2**30)
    with pytest.raises(lx.MachineFileError, match=r"machine.sdf has 1073741824 bytes"):
        lx.load(path)
    for absent in (tmp_path / "absent.urdf", tmp_path, "\x00.urdf"):
        with pytest.raises(lx.MachineFileError, match=r"is no file|cannot read"):
            lx.load(absent)


def test_many_links_take_time_in_proportion(tmp_path):
    """A chain of three thousand links loads in seconds."""
    link = '<link name="l{i}"/><joint name="j{i}" type="fixed"><parent link="l{before}"/><child link="l{i}"/></joint>'
    chain = "".join(link.format(i=i, before=i - 1) for i in range(1, 3000))
    path = tmp_path / "chain.urdf"
    path.write_text(f'<robot name="chain"><link name="l0"/>{chain}</robot>')
    begun = time.monotonic()
    assert len(lx.load(path).bodies) == 3000
    assert time.monotonic() - begun < 20.0
