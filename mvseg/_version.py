"""Which mvseg this is: a version for people, and a hash of the code that tells whether a result was made by the same
code.

The version is the installation's, which the build takes from git. It does not tell of changes since in an
editable checkout, or of a source tree that was never installed; the hash covers both.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGE = Path(__file__).parent
CODE = (".py", ".js", ".css", ".html")  # what results are made by; weights, options and plants are inputs


def _installed_version() -> str:
    """The version of the installation; "0+unknown" for a source tree that nobody installed."""
    try:
        return version("mvseg")
    except PackageNotFoundError:
        return "0+unknown"


__version__ = _installed_version()


@cache
def code_hash(package: Path = PACKAGE) -> str:
    """A hash of the package's source files and their paths, 16 hexadecimal digits; some 20 ms for the first call."""
    files = {path.relative_to(package).as_posix(): path for path in package.rglob("*") if path.suffix in CODE}
    lines = [f"{hashlib.sha256(files[name].read_bytes()).hexdigest()}  {name}\n" for name in sorted(files)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()[:16]


def made_by() -> dict[str, str]:
    """Entry of run.json about the mvseg that made a result."""
    return {"mvseg": __version__, "code": code_hash()}
