"""The files that a stage is made of: where they may lie, and what is refused in them before USD opens them.

USD resolves names of files itself, and its parser of text recurses; both are checked here first.
"""

import os
import re
import zipfile
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

from linkax.machines.draft import Draft
from linkax.machines.xml import DEEPEST, MachineFileError, below, read_file

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MOST_FILES = 1000  # that a stage is made of
TOKEN = re.compile(  # of a text: strings, paths of files and comments, which may have brackets in them, and brackets
    rb'"""(?:\\.|[^\\])*?"""|"(?:\\.|[^"\\\n])*"'
    rb"|'''(?:\\.|[^\\])*?'''|'(?:\\.|[^'\\\n])*'"
    rb"|@@@.*?@@@|@[^@\n]*@|#[^\n]*|//[^\n]*|/\*.*?\*/|[{}()\[\]]",
    re.DOTALL,
)


def check_files(sdf: Any, path: Path, draft: Draft) -> None:
    """Check where all files lie that a stage is made of, before USD opens them.

    **Raises:** `MachineFileError` for one outside of the folder, one that is not there, no USD, or too large.
    """
    seen, open_ones = {path}, [path]
    while open_ones:
        file = open_ones.pop()
        fail = lambda message, file=file: MachineFileError(f"{file.name}: {message}")
        for layer, inside in _layers(sdf, file, fail):
            for named in _named(sdf, layer, fail):
                if inside is not None:
                    if str(inside[0] / named) not in inside[1]:
                        raise fail(f"{named[:200]!r} is not in the package; put it there")
                    continue
                below(file.parent, named, draft.folders, fail)
                found = Path(os.path.normpath(file.parent / named))  # USD does not resolve links on the way
                if found in seen:
                    continue
                if found.suffix.lower() not in SUFFIXES or not found.is_file() or len(seen) == MOST_FILES:
                    raise fail(
                        f"{named[:200]!r}, which it refers to, is not there, is no USD, or is one too many; take it out"
                    )
                read_file(found)
                seen.add(found)
                open_ones.append(found)


def _layers(sdf, file, fail):
    """The layers in a file; of a package also the folder of each in it, and all names in it."""
    if file.suffix.lower() != ".usdz":
        _check_depth(read_file(file), fail)
        yield sdf.Layer.FindOrOpen(str(file)), None
        return
    try:
        with zipfile.ZipFile(file) as package:
            members = [member for member in package.infolist() if member.filename.lower().endswith(SUFFIXES)]
            for member in members:
                if member.compress_type != zipfile.ZIP_STORED or member.filename.lower().endswith(".usdz"):
                    raise fail(f"{member.filename!r} is compressed, or a package in a package; take it out")
                _check_depth(package.read(member), fail)
            names = package.namelist()
    except (zipfile.BadZipFile, NotImplementedError, EOFError, RuntimeError) as error:
        raise MachineFileError(f"{file.name}: USD does not read it: no package, {error}") from error
    for member in members:
        layer = sdf.Layer.FindOrOpen(f"{file}[{member.filename}]")
        yield layer, (PurePosixPath(member.filename).parent, names)


def _check_depth(data: bytes, fail: Callable[[str], MachineFileError]) -> None:
    """Refuse a text with more brackets inside each other than USD's parser, which recurses, has room for."""
    depth = 0
    for match in TOKEN.finditer(data) if data.startswith(b"#usda") else ():
        depth += (match[0] in b"{([") - (match[0] in b"})]")
        if depth > DEEPEST:
            raise fail(f"more than {DEEPEST} prims or brackets inside each other; no machine has so many")


def _named(sdf, layer, fail):
    """The names of other files in a layer; clips, which name more, are refused."""
    if layer is None:
        raise fail("USD does not open it")

    def check(path):
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, sdf.PrimSpec) and spec.HasInfo("clips"):
            raise fail(f"{path} has value clips; take them out")

    layer.Traverse(sdf.Path.absoluteRootPath, check)
    return [name for name in layer.GetCompositionAssetDependencies() if name]
