"""Public names of a package, whose modules are imported when a name is first used: `import mvseg` takes no time."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module


def lazy_names(package: str, file: str) -> tuple[Callable[[str], object], list[str]]:
    """The `__getattr__` (PEP 562) and `__all__` of a package. Its names are those that its `__init__.py`, `file`,
    imports for type checkers, each on a line of its own, as in "    from mvseg.scene import Scene as Scene"."""
    with open(file, encoding="utf-8") as source:
        imports = [line.split() for line in source if line.startswith("    from mvseg.")]
    home = {words[-1]: words[1] for words in imports if words[-2] == "as"}

    def load(name: str) -> object:
        if name not in home:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(home[name]), name)

    return load, list(home)
