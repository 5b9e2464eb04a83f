"""Libraries that linkax imports only where they are needed, and its package installs by an extra."""

import importlib
from typing import Any


def needed(module: str, need: str, extra: str, kind: type[Exception] = ImportError) -> Any:
    """Import a module.

    **Arguments:** `need`: in words, who needs it. `extra`: of linkax's package, which installs it. `kind`: of error.

    **Raises:** an error of that kind that says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise kind(f"{need}; pip install 'linkax[{extra}]'") from error
