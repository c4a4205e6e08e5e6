"""Public names of a package, whose modules are imported when a name is first used: `import mvseg` takes no time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module


def lazy_names(package: str, home: Mapping[str, Sequence[str]]) -> Callable[[str], object]:
    """The `__getattr__` of a package (PEP 562); `home` are {module in it: public names that it holds}."""

    def load(name: str) -> object:
        for module, names in home.items():
            if name in names:
                return getattr(import_module(f"{package}.{module}"), name)
        raise AttributeError(f"module '{package}' has no attribute '{name}'")

    return load
