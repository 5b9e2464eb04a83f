"""XML with the line of each element, read without entities, and no larger than a machine is."""

import math
import os
from collections.abc import Callable, Container, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np

from linkax.model.names import meant
from linkax.model.numbers import number_in
from linkax.optional import needed

LARGEST = 64 * 2**20  # bytes of a file
DEEPEST = 200  # elements inside each other
MOST = 1_000_000  # elements


class MachineFileError(ValueError):
    """A file of a machine cannot be read, or asks for what linkax does not model; tells the file, line and element."""


class Where(NamedTuple):
    """An element of a file: its path, line, tag and name."""

    path: Path
    line: int
    tag: str
    name: str

    def __str__(self) -> str:
        what = f"{self.tag} {self.name!r}" if self.name else self.tag
        return f"{self.path.name}:{self.line}: {what}"

    def error(self, message: str) -> MachineFileError:
        """Make an error about this element."""
        return MachineFileError(f"{self}: {message}")


class Node:
    """An element of XML: `tag`, `attributes`, `text`, `children`, and `where` it is.

    It remembers what a reader asks of it by its methods, so that `unread` tells what no reader asked for.
    """

    def __init__(self, path: Path, line: int, tag: str, attributes: dict[str, str]) -> None:
        self.tag, self.attributes, self.text = tag, attributes, ""
        self.children: list[Node] = []
        self.path, self.line = path, line
        self._asked = set[str]()  # attributes and tags that were asked for, there or not
        self._is_read = self._is_told = False

    @property
    def where(self) -> Where:
        """Its place in the file."""
        return Where(self.path, self.line, self.tag, self.attributes.get("name", ""))

    @property
    def name(self) -> str:
        """Its `name`.

        **Raises:** `MachineFileError` without one.
        """
        return self.attribute("name")

    def get(self, name: str, default: str = "") -> str:
        """The text of an attribute, which may be absent."""
        self._asked.add(name)
        return self.attributes.get(name, default).strip()

    def attribute(self, name: str) -> str:
        """The text of an attribute that must be there.

        **Raises:** `MachineFileError` without it.
        """
        found = self.get(name)
        if not found:
            raise self.where.error(f'it has no {name}; give {name}="..."')
        return found

    def all(self, *tags: str) -> list["Node"]:
        """The children with one of several tags."""
        self._asked.update(tags)
        found = [child for child in self.children if child.tag in tags]
        for child in found:
            child._is_read = True
        return found

    def find(self, way: str) -> "Node | None":
        """The first child of a tag, or along tags separated by "/"."""
        tag, _, rest = way.partition("/")
        self._asked.add(tag)
        found = next((child for child in self.children if child.tag == tag), None)
        if found is None:
            return None
        found._is_read = True
        return found.find(rest) if rest else found

    def child(self, tag: str) -> "Node":
        """The first child of a tag, which must be there.

        **Raises:** `MachineFileError` without it.
        """
        found = self.find(tag)
        if found is None:
            raise self.where.error(f"it has no <{tag}>; give one")
        return found

    def content(self, way: str) -> str | None:
        """The text of the first child along tags; None without one."""
        found = self.find(way)
        return None if found is None else found.text.strip()

    def number(self, way: str, default: float | None = None) -> float:
        """The number in the text of a child along tags.

        **Raises:** `MachineFileError` for what is no finite number, and without one where there is no default.
        """
        found = self.find(way)
        if found is None:
            if default is None:
                raise self.where.error(f"it has no <{way}>; give a number there")
            return default
        return float(read_numbers(found.text, 1, found.where)[0])

    def numbers(self, name: str, count: int, default: Sequence[float] | None = None) -> np.ndarray:
        """The numbers in an attribute.

        **Raises:** `MachineFileError` for others than `count` finite numbers, and where there are none and no default.
        """
        self._asked.add(name)
        if name not in self.attributes and default is not None:
            return np.array(default, dtype=float)
        return read_numbers(self.attribute(name), count, self.where, name)

    def moves_nothing(self) -> None:
        """Note that nobody need be told what no reader asks of the element, and of what is in it."""
        self._is_told = True

    def unread(self, told: Container[Where]) -> Iterator[tuple[Where, str, str, bool]]:
        """Say what no reader asked for: where, the name, the reason, and whether a reader should have read it.

        It should where the name is nearly one that was looked for in vain, or an element is there once too often.

        **Arguments:** `told`: elements of which it is told already.
        """
        absent = self._asked - set(self.attributes) - {child.tag for child in self.children}
        others = []
        unknown = [name for name in self.attributes if name not in ("name", *self._asked) and name[:5] != "xmlns"]
        for name in unknown:
            if close := meant(name, absent):
                yield self.where, name, f"attribute {name!r} is not known{close}", True
            else:
                others.append(name)
        for child in self.children:
            if child._is_told or child.where in told:
                continue
            if child._is_read:
                yield from child.unread(told) if child._asked else ()
            elif child.tag in self._asked:
                yield child.where, child.tag, f"<{child.tag}> is there already; take one out", True
            elif close := meant(child.tag, absent):
                yield child.where, child.tag, f"<{child.tag}> is not known{close}", True
            elif f"<{child.tag}>" not in others:
                others.append(f"<{child.tag}>")
        if others:
            yield self.where, "unread", f"{', '.join(others)} in it: not read", False

    def __iter__(self) -> Iterator["Node"]:
        return iter(self.children)


def read_numbers(text: str, count: int, where: Where, what: str = "its text") -> np.ndarray:
    """Read numbers that spaces separate.

    **Raises:** `MachineFileError` for others than `count` finite numbers.
    """
    try:
        found = [number_in(part) for part in text.split()]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise where.error(f"{what} is {text.strip()[:60]!r}; it must be {count} finite number{'s' * (count > 1)}")
    return np.array(found)


def read_file(path: Path) -> bytes:
    """Read a file that is not too large.

    **Raises:** `MachineFileError` for one that is not there, no file, or too large.
    """
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise MachineFileError(f"{str(path)!r} is no file; give the path of one")
        if size > LARGEST:
            raise MachineFileError(
                f"{path.name} has {size} bytes; a file may have {LARGEST}, take out what is no machine"
            )
        return path.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, MachineFileError):
            raise
        raise MachineFileError(f"cannot read {str(path)!r}: {getattr(error, 'strerror', None) or error}") from error


def read_xml(path: Path) -> Node:
    """Read an XML file; what refers to other files, and entities, is refused.

    **Raises:** `MachineFileError` with the line, for what is no XML, has a document type, is too deep, or has too many
    elements.
    """
    parser = expat.ParserCreate()
    open_ones: list[Node] = []
    roots: list[Node] = []
    counted = 0

    def refuse(message: str) -> MachineFileError:
        return MachineFileError(f"{path.name}:{parser.CurrentLineNumber}: {message}")

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal counted
        counted += 1
        if counted > MOST or len(open_ones) > DEEPEST:
            raise refuse(f"more than {MOST} elements, or {DEEPEST} inside each other; no machine has so many")
        node = Node(path, parser.CurrentLineNumber, tag, attributes)
        (open_ones[-1].children if open_ones else roots).append(node)
        open_ones.append(node)

    def text(data: str) -> None:
        if open_ones:
            open_ones[-1].text += data

    def doctype(*_: object) -> None:
        raise refuse("it has a document type, which may define entities or name other files; take <!DOCTYPE ...> out")

    parser.buffer_text = True
    parser.StartElementHandler, parser.CharacterDataHandler = start, text
    parser.EndElementHandler = lambda _: open_ones.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(read_file(path), True)
    except expat.ExpatError as error:
        told = expat.ErrorString(error.code)
        raise MachineFileError(f"{path.name}:{error.lineno}: no XML, {told}; mend the file there") from error
    except (UnicodeError, LookupError, ValueError) as error:
        if isinstance(error, MachineFileError):
            raise
        raise refuse(f"cannot be read, {error}") from error
    return roots[0]


def library(module: str, path: Path, reads: str) -> Any:
    """Import the library that reads a format.

    **Raises:** `MachineFileError` that says how to install it.
    """
    return needed(module, f"{path.name} is {reads} reads", "files", MachineFileError)


def below(folder: Path, name: str, roots: Sequence[Path], fail: Callable[[str], MachineFileError]) -> Path:
    """The path that a file gives, relative to a folder, which must lie below one of several roots.

    **Raises:** the error that `fail` makes, for a path outside.
    """
    try:
        path = Path(os.path.realpath(folder / name))
        inside = any(path.is_relative_to(os.path.realpath(root)) for root in roots)
    except (OSError, ValueError) as error:
        raise fail(f"{name[:200]!r} is no path: {error}") from error
    if not inside:
        raise fail(f"{name[:200]!r} lies outside of the file's folder; allow others by folders=[...]")
    return path
