"""Read a machine from a file, by its format."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Literal

from linkax.machines.draft import Draft
from linkax.machines.machine import Machine
from linkax.machines.mjcf.read import read_mjcf
from linkax.machines.sdf import read_sdf
from linkax.machines.urdf import close_by_yaml, read_urdf
from linkax.machines.usd.files import SUFFIXES
from linkax.machines.usd.read import read_usd
from linkax.machines.xml import Node, read_xml
from linkax.model.numbers import listed, one_of, require_bool

Base = Literal["free", "fixed"]
READERS: dict[str, tuple[Callable[[Node, Draft], None], Base]] = {
    "mujoco": (read_mjcf, "fixed"),
    "robot": (read_urdf, "fixed"),
    "sdf": (read_sdf, "free"),
}


def load(
    path: str | os.PathLike[str],
    *,
    ignore: Iterable[str] = ("contact",),
    base: Base | None = None,
    closures: str | os.PathLike[str] | None = None,
    folders: Iterable[str | os.PathLike[str]] = (),
    whole_angles: bool = False,
) -> Machine:
    """Read a machine from a file: MJCF, SDF, URDF or USD, with its closed loops.

    ```python
    machine = lx.load("gripper.xml")
    gripper = machine.mechanism({"forces": {"finger.spring": {"stiffness": 0.4}}})
    state = lx.assemble(gripper, {"left_driver": 0.3})
    ```

    Loops are found, whatever the file says of the tree: SDF and URDF may give a link several parents, URDF also the
    elements <loop>, <coupling> and <constraint>, MJCF <equality>, whose two <connect> between the same bodies make a
    hinge. Coordinates are zero where the machine stands as drawn; in USD where a joint's two frames coincide, and
    `Machine.starts["drawn"]` has those of the drawing where it is another place.

    What linkax does not model is in `Machine.left_out`, and what it does not know in URDF and SDF, too. Where that
    changes the motion, or is nearly the name of something that is missing, it must be in `ignore`, and a warning
    (`LeftOutWarning`) names some of it. Stops and dry friction have laws of linkax: where the file does not say how
    stiff a stop is, the weight of the machine at its size presses it by 0.001 rad; dry friction is nearly viscous
    below 0.01 rad/s. Both are in `Machine.params`.

    Names are unique for each kind of element in a file, and among joints, constraints and forces in a mechanism. Bodies
    and joints keep theirs; a constraint, a force, or a joint that closes a loop gets its kind in the file added where
    the name is taken, as "elbow.actuator", and `Machine.left_out` tells so.

    What bodies are drawn as is in `Machine.shapes`; meshes that are not there change no motion.

    XML is read without entities; other files are read only below the folder of the file.

    **Arguments:**

    - `path`: of the file. MJCF needs MuJoCo (`pip install "linkax[files]"`), which reads it, and
      USD (.usd, .usda, .usdc, .usdz) its usd-core.
    - `ignore`: kinds of things to leave out. By default "contact", between any shapes; also "limit", "spring",
      "damping", "friction" and "actuator", which linkax has, and what an error names.
    - `base`: "free" or "fixed": how the first body of what nothing joins to the ground moves. By default "free" in
      SDF and USD, "fixed" in URDF and MJCF.
    - `closures`: for URDF, a YAML file of pairs of links that coincide: `closed_loop: [[a, b], ...]`, with
      `type: [3d, ...]` for points, or 6d; and of joints that are of another type than URDF has: `joint_name: [a, ...]`
      with `joint_type: [SPHERICAL, FIXED, UJOINT_XY, ...]`, the last about x, then y of its frame.
    - `folders`: further ones below which files may be read. `package://robot/...` and `model://robot/...`, as addresses
      of meshes, are in a folder `robot` there, or in one there that lies in `robot`.
    - `whole_angles`: take angles that are rounded multiples of 15 degrees, such as 1.5708 or 1.57 for π/2, as what they
      stand for. Axes that are meant to be parallel then are, and a planar loop is not locked by the digits of the file.

    **Raises:** `MachineFileError`, a `ValueError`, with file, line and element: for a file that cannot be read, and for
    what changes the motion, is not modelled, and not in `ignore`.
    """
    path = Path(path)
    ignored = (ignore,) if isinstance(ignore, str) else listed(ignore, str, "ignore", 'give words such as ["contact"]')
    draft = Draft(path, tuple(ignored), (path.parent, *map(Path, folders)), require_bool(whole_angles, "whole_angles"))
    usual = _read(draft)
    if closures is not None:
        close_by_yaml(draft, Path(closures))
    return draft.machine(usual if base is None else one_of(base, ("free", "fixed"), "base"))


def _read(draft: Draft) -> Base:
    """Fill a draft, and return how a base moves that the format does not join to the ground."""
    if draft.path.suffix.lower() in SUFFIXES:
        read_usd(draft)
        return "free"
    root = read_xml(draft.path)
    if root.tag not in READERS:
        raise root.where.error(f"the file is no machine; it must begin with {', '.join(f'<{tag}>' for tag in READERS)}")
    reader, base = READERS[root.tag]
    reader(root, draft)
    return base
