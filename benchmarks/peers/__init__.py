"""Other simulators on linkax's mechanisms: of hinges and slides, in the tree or closing loops, under gravity.

`PEERS[name]` is a module with

- `settings()`: its `Setting`s, method by method, from coarse to fine;
- `run(description, setting, times)`: the `Run` of a `benchmarks.peers.description.Description`.
"""

import importlib
from collections.abc import Iterator, Mapping
from types import ModuleType


class _Peers(Mapping):
    """Modules by name, each imported when it is asked for."""

    names = ("mujoco", "mjx", "pinocchio", "exudyn")

    def __getitem__(self, name: str) -> ModuleType:
        if name not in self.names:
            raise KeyError(f"unknown peer {name!r}; known: {', '.join(self.names)}")
        try:
            return importlib.import_module(f"{__name__}.{name}")
        except ModuleNotFoundError as error:
            message = f"peer {name!r} needs {error.name!r}, which is not installed; install linkax[peers]"
            raise ModuleNotFoundError(message, name=error.name) from error

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


PEERS: Mapping[str, ModuleType] = _Peers()
