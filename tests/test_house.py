"""The house: what imports what, what the wheel holds, what the README promises."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import mvseg

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "mvseg"

# A module imports only from those before it in this list; a folder stands for its files.
ORDER = [
    "errors",
    "_version",
    "scene",
    "regions",
    "partition",
    "demo",
    "formats",
    "detectors",
    "matching",
    "reconstruction",
    "multiview",
    "evaluation",
    "baselines",
    "config",
    "training",
    "results",
    "pipeline",
    "simulation",
    "cli",
]


def stage(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports_of(path: Path) -> set[str]:
    """Stages of mvseg that a file imports when it is loaded (not inside functions, not for type checkers)."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = set()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mvseg."):
            found.add(str(node.module).split(".")[1])
        assert not (isinstance(node, ast.Import) and any(name.name == "models" for name in node.names))
    return found


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_imports_go_one_way(path: Path) -> None:
    if path == PACKAGE / "__init__.py":
        return
    assert stage(path) in ORDER
    earlier = ORDER[: ORDER.index(stage(path)) + 1]
    assert imports_of(path) <= set(earlier)


def test_every_public_name_is_there_and_importing_the_package_is_cheap() -> None:
    for name in mvseg.__all__:
        assert getattr(mvseg, name) is not None
    code = "import sys, mvseg, mvseg.cli; sys.exit(int('torch' in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        mvseg.nothing  # noqa: B018


def test_public_names_for_type_checkers_are_the_same() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    typed = {name.asname for node in block.body if isinstance(node, ast.ImportFrom) for name in node.names}
    assert typed == set(mvseg.__all__) - {"__version__"}


def test_the_readmes_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len(example.strip().splitlines()) <= 20
    monkeypatch.chdir(tmp_path)
    scope: dict = {}
    exec(compile(example, "README.md", "exec"), scope)
    assert scope["matching"].num_instances == 12


def test_wheel_holds_one_package_with_the_shipped_scene(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    top = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert top == {"mvseg"}
    assert {"mvseg/demo_plant/cameras.json", "mvseg/py.typed", "mvseg/zoo/leaf-slim/weights.safetensors"} <= set(names)


def test_shipped_scene_is_small() -> None:
    size = sum(file.stat().st_size for file in (PACKAGE / "demo_plant").rglob("*") if file.is_file())
    assert size <= 3_000_000


def test_shipped_masks_are_what_the_script_makes(tmp_path: Path) -> None:
    from mvseg.simulation.demo_plant import write_demo_plant

    write_demo_plant(tmp_path / "plant")
    shipped = sorted((PACKAGE / "demo_plant").rglob("*.png"))
    assert len(shipped) == 18
    for file in shipped:
        assert (tmp_path / "plant" / file.relative_to(PACKAGE / "demo_plant")).read_bytes() == file.read_bytes()


@pytest.mark.parametrize("config", sorted((ROOT / "configs").rglob("*.yaml")), ids=lambda path: path.name)
def test_published_configs_are_understood(config: Path) -> None:
    from mvseg.cli import build_parser

    verb = "train" if config.parent.name == "train" else "infer"
    args = build_parser().parse_args([verb, "--config", str(config)])
    assert args.verb == verb
