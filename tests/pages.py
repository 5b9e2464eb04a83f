"""What pages show, run block by block, as someone would who types them in."""

import re
import tempfile
from contextlib import chdir
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path

ROOT = Path(__file__).parents[1]
FEWER = {"2.0, 100)": "2.0, 10)"}  # members of a batch


@cache
def blocks(page: str) -> tuple[str, ...]:
    """The blocks of Python of a page, by its path from the root."""
    text = (ROOT / page).read_text()
    for shown, ran in FEWER.items():
        text = text.replace(shown, ran)
    return tuple(re.findall(r"```python\n(.*?)```", text, re.DOTALL))


@dataclass
class Page:
    """A page whose blocks run in a folder of their own, one after the other, each once.

    - `names`: what they have left.
    """

    path: str
    names: dict = field(default_factory=lambda: {"__name__": "__main__"})
    ran: int = 0

    @cached_property
    def _folder(self):
        return tempfile.TemporaryDirectory()  # removed with the page

    @property
    def folder(self) -> Path:
        return Path(self._folder.name)

    def run(self, count: int) -> None:
        """Run blocks up to this one, counted from 1, but for those that ran."""
        with chdir(self.folder):
            while self.ran < count:
                self.ran += 1
                exec(compile(blocks(self.path)[self.ran - 1], f"{self.path}, block {self.ran}", "exec"), self.names)


page = cache(Page)
