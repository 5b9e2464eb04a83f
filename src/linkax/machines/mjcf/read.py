"""Read an MJCF file: check the files that it names, let MuJoCo compile it, and fill a draft from the model."""

from typing import Any

from linkax.machines.draft import Draft
from linkax.machines.mjcf.actuators import read_actuators
from linkax.machines.mjcf.bodies import read_body
from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.mjcf.equalities import read_equalities
from linkax.machines.mjcf.files import check_files, take_out_missing
from linkax.machines.mjcf.starts import read_starts
from linkax.machines.mjcf.tendons import read_tendons
from linkax.machines.xml import MachineFileError, Node, Where, library

SUFFIXES = (".xml", ".urdf")  # by which MuJoCo knows the format, in these letters


def read_mjcf(root: Node, draft: Draft) -> None:
    """Fill a draft from an MJCF file.

    **Raises:** `MachineFileError` for what MuJoCo does not read, with its message, and without MuJoCo.
    """
    mujoco = library("mujoco", draft.path, "MJCF, which MuJoCo")
    if draft.path.suffix not in SUFFIXES:
        raise MachineFileError(f"{draft.path.name}: MuJoCo reads files whose names end in .xml; rename it")
    try:
        _read_model(_compiled(mujoco, root, draft))
    except UnicodeDecodeError as error:
        raise MachineFileError(
            f"{draft.path.name}: a name in it is not in UTF-8; save it so, MuJoCo reads no other"
        ) from error


def _compiled(mujoco: Any, root: Node, draft: Draft) -> Compiled:
    missing = check_files(root, draft)
    try:
        spec = mujoco.MjSpec.from_file(str(draft.path))
        take_out_missing(spec, missing, draft)
        return Compiled(mujoco, spec, spec.compile(), draft)
    except UnicodeDecodeError:
        raise
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise MachineFileError(f"{draft.path.name}: MuJoCo does not read it: {' '.join(str(error).split())}") from error


def _read_model(compiled: Compiled) -> None:
    """Read bodies with their joints, then all else."""
    model, draft = compiled.model, compiled.draft
    draft.name = compiled.spec.modelname
    whole = Where(draft.path, 1, "mujoco", draft.name)
    draft.gravity(compiled.gravity, whole)
    if model.opt.density or model.opt.viscosity:
        draft.leave_out(whole, "fluid", "forces of the medium: density, viscosity and wind of <option>")
    for count, kind in ((model.nflex, "flex"), (model.nplugin, "plugin"), (model.nskin, "skin")):
        if count:
            draft.leave_out(whole, kind, f"{count} <{kind}>", kind != "skin")
    if model.npair and compiled.has("CONTACT"):
        draft.leave_out(whole, "contact", f"contact of {model.npair} <pair>")
    for body in range(1, model.nbody):
        read_body(compiled, body)
    if compiled.has("EQUALITY"):
        read_equalities(compiled)
    read_tendons(compiled)
    if compiled.has("ACTUATION"):
        read_actuators(compiled)
    for sensor in sorted(compiled.elements("sensor")):
        draft.leave_out(compiled.where("sensor", sensor), "sensor", "a sensor does not move anything", False)
    read_starts(compiled)
