"""The house: what imports what, what the wheel holds, what the README promises."""

from __future__ import annotations

import ast
import inspect
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable
from dataclasses import fields
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.util import resolve_name
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import mvseg
import mvseg.matching
from benchmarks.demo_plant import write_demo_plant, write_demo_plant_later
from mvseg._version import code_hash, made_by
from mvseg.cli import command
from mvseg.training.config import TrainConfig

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "mvseg"

# A room (a folder, or a module of the top level) imports only from the lines above its own, so rooms of one line never
# import each other. `__init__` stands for `mvseg` itself: below it, nothing imports the package.
FLOORS = (
    ("findings", "arrays", "_version"),
    ("errors",),
    ("system", "table"),
    ("scene", "crop"),
    ("regions",),
    ("masks", "demo"),
    ("formats", "detectors", "matching", "reconstruction"),
    ("verification", "traits", "evaluation", "simulation", "poses"),
    ("corrections", "detection", "checks"),
    ("config",),
    ("results",),
    ("tracking", "training"),
    ("pipeline",),
    ("runs",),
    ("batch", "server"),
    ("__init__",),
    ("cli",),
)
parse = cache(ast.parse)  # each module once
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): path.read_text(encoding="utf-8")
    for path in sorted(PACKAGE.rglob("*.py"))
}


def room_of(module: str) -> str:
    """The room of "mvseg.formats.coco" is "formats"; that of "mvseg" is "__init__"."""
    return [*module.split("."), "__init__"][1]


def imported_modules(source: str, module: str) -> set[str]:
    """What a module imports, anywhere in it: in functions, in `if TYPE_CHECKING` and by relative imports, too."""
    package = module.rpartition(".")[0]
    imported: set[str] = set()
    for node in ast.walk(parse(source)):
        if isinstance(node, ast.Import):
            imported.update(name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            imported.add(resolve_name("." * node.level + (node.module or ""), package))
    return imported


def imported_rooms(source: str, module: str) -> set[str]:
    """Rooms that a module imports.

    `from mvseg import x` imports `__init__`, whatever x is: names of rooms and public names look alike there.
    """
    return {room_of(name) for name in imported_modules(source, module) if name.split(".")[0] == "mvseg"}


def forbidden_rooms(source: str, module: str) -> set[str]:
    """Of these, the rooms that do not lie above the module's own; rooms without a floor are forbidden."""
    own = room_of(module)
    others = imported_rooms(source, module) - {own}
    return {room for room in others if FLOOR_OF.get(room, len(FLOORS)) >= FLOOR_OF[own]}


def test_contributors_read_the_floors_as_they_are() -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert "\n".join("  ".join(rooms) for rooms in FLOORS) in page


def test_contributors_find_every_room_benchmark_and_script() -> None:
    """A room says what it does in its `__init__.py`; tables name all scripts that run, and all of the pages."""
    rooms = {module.rpartition(".")[0] for module in MODULES} - {""}
    docstrings = {room: ast.get_docstring(parse(MODULES.get(f"{room}.__init__", ""))) for room in rooms}
    assert {room for room, docstring in docstrings.items() if not docstring} == set()
    cells = [line.split("|")[1] for line in (ROOT / "CONTRIBUTING.md").read_text("utf-8").splitlines() if "|" in line]
    named = {name for cell in cells for name in re.findall(r"`([\w/.]+)`", cell)}
    home = ROOT / "benchmarks"
    scripts = [path for path in home.rglob("*.py") if 'if __name__ == "__main__"' in path.read_text("utf-8")]
    paths = {path.relative_to(home).as_posix() for path in scripts}
    assert {path for path in paths if not {path, path.partition("/")[0] + "/"} & named} == set()
    assert {path.name for path in PACKAGE.rglob("assets/*.js")} <= named
    assert {name for name in named if name.endswith(".js")} <= {path.name for path in PACKAGE.rglob("assets/*.js")}


def test_imports_go_one_way() -> None:
    assert {room_of(module) for module in MODULES} <= FLOOR_OF.keys()
    forbidden = {module: forbidden_rooms(source, module) for module, source in MODULES.items()}
    assert {module: rooms for module, rooms in forbidden.items() if rooms} == {}


# Lines of Python, at most; 34,000, 6,800 and 31,000 are where they are to go. CONTRIBUTING.md says what a change owes.
BUDGET = {"mvseg": 37_160, "benchmarks": 6_493, "tests": 32_881}
SLACK, MOST_CODE = 400, 21_307


@pytest.mark.parametrize("place", BUDGET)
def test_the_house_does_not_grow(place: str) -> None:
    lines = sum(len(path.read_text("utf-8").splitlines()) for path in (ROOT / place).rglob("*.py"))
    assert lines <= BUDGET[place], "delete as much as was added, or raise the budget with a reason in CONTRIBUTING.md"
    assert lines > BUDGET[place] - SLACK, "lower the budget to what is left"


def test_the_code_does_not_grow() -> None:
    """Lines that are neither blank nor of a comment, a docstring or an import; 19,500 are where they are to go."""
    count = 0
    for source in MODULES.values():
        other = set[int]()
        for node in ast.walk(parse(source)):
            is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
            if isinstance(node, ast.Import | ast.ImportFrom) or is_text:
                other |= {*range(node.lineno, node.end_lineno + 1)}
        lines = enumerate((line.strip() for line in source.splitlines()), 1)
        count += sum(bool(line) and not line.startswith("#") and number not in other for number, line in lines)
    assert MOST_CODE - SLACK < count <= MOST_CODE


def test_nobody_is_he() -> None:
    pages = [path for place in ("mvseg", "benchmarks") for path in (ROOT / place).rglob("*.py")]
    pages += [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    assert {path.name for path in pages if re.search(r"\b(he|his|him)\b", path.read_text("utf-8"))} == set()


def test_sentences_have_a_noun_or_a_verb_at_their_head() -> None:
    """And none hangs on "of what", "of those that" or "of these that"; the user is "the user"."""
    phrases = re.compile(r"\bof what\b|\bof those that\b|\bof these that\b|\ba\s+person\b", re.IGNORECASE)
    assert {module for module, source in MODULES.items() if phrases.search(source)} == set()
    heads = re.compile(r"(?:what|which|where|that|of|those|these)\b", re.IGNORECASE)
    public = [(module, node.name) for module, source in MODULES.items() for node in ast.walk(parse(source))
              if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
              and heads.match(ast.get_docstring(node) or "")]  # fmt: skip
    assert public == []


VAGUE = {"found", "known", "said", "seen", "shown", "left", "kept"}


def test_vague_names_live_for_three_lines_at_most() -> None:
    """Within a function; beside another side, `left` is a side."""
    lasting = set()
    for module, source in MODULES.items():
        for function in (node for node in ast.walk(parse(source)) if isinstance(node, ast.FunctionDef)):
            lines: dict[str, list[int]] = {}
            for node in ast.walk(function):
                if isinstance(node, ast.Name):
                    lines.setdefault(node.id, []).append(node.lineno)
            vague = VAGUE & {name for name, each in lines.items() if max(each) - min(each) > 3}
            sides = {"left"} if {"right", "top", "bottom"} & lines.keys() else set()
            lasting |= {(module, function.name, name) for name in vague - sides}
    assert lasting == set()


def test_fields_arguments_and_definitions_have_no_vague_names() -> None:
    vague = set()
    for module, source in MODULES.items():
        for node in ast.walk(parse(source)):
            names = [node.name] if isinstance(node, ast.FunctionDef | ast.ClassDef) else []
            if isinstance(node, ast.FunctionDef | ast.Lambda):
                names += [each.arg for each in (*node.args.args, *node.args.kwonlyargs)]
            if isinstance(node, ast.ClassDef):
                fields = [each.target for each in node.body if isinstance(each, ast.AnnAssign)]
                names += [each.id for each in fields if isinstance(each, ast.Name)]
            vague |= {(module, name) for name in names if name.strip("_").lower() in VAGUE}
    assert vague == set()


def test_public_names_are_given_once() -> None:
    """But for verbs of the command line, which have the same functions."""
    places: dict[str, list[str]] = {}
    for module, source in MODULES.items():
        for node in parse(source).body if room_of(module) != "cli" else ():
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(module)
    assert {name: of for name, of in places.items() if len(of) > 1} == {}


def test_no_two_modules_need_each_other() -> None:
    """Inside of rooms, too, and for types alone; `__init__` of a room takes from its modules, which is no circle."""
    imports = {module: imported_modules(source, module) & MODULES.keys() for module, source in MODULES.items()}
    rooms = {module for module in MODULES if module.endswith("__init__")}
    TopologicalSorter({module: imports[module] for module in MODULES.keys() - rooms}).prepare()  # raises CycleError
    with pytest.raises(CycleError):
        TopologicalSorter({"a": {"b"}, "b": {"c"}, "c": {"a"}}).prepare()


def test_every_module_is_imported_by_another() -> None:
    """But for those of verbs, which `cli.command` imports by their short names."""
    imported = {name for source in MODULES.values() for name in re.findall(r"(?:from|import) (mvseg[\w.]+)", source)}
    doors = {module for module in MODULES if module.endswith("__init__") or room_of(module) == "cli"}
    assert MODULES.keys() - doors - imported == set()


@pytest.mark.parametrize(
    ("line", "room"),
    [
        ("import os, mvseg.results.folder as folder", "results"),
        ("from mvseg.results.folder import save_result", "results"),
        ("from ..results import folder", "results"),
        ("from mvseg import regions", "__init__"),
        ("def run():\n    import mvseg.pipeline", "pipeline"),
        ("if TYPE_CHECKING:\n    from mvseg.pipeline.run_scene import run_scene", "pipeline"),
        ("from mvseg.matching.affinity import Affinity", "matching"),  # a room of the same floor
        ("from mvseg.attic import x", "attic"),  # a room that has no floor
    ],
)
def test_every_kind_of_forbidden_import_is_seen(line: str, room: str) -> None:
    source = f"import torch\nfrom mvseg.errors import InputError\n\n{line}\n"
    assert forbidden_rooms(source, "mvseg.formats.coco") == {room}


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("mvseg.formats.coco", "from . import lens\nfrom .rig import load\nimport mvseg.formats.mesh"),  # its own room
        ("mvseg.formats.coco", "import models\nfrom mvsegment import x\nimport mvsegment.results"),  # other packages
        ("mvseg.formats.coco", "from mvseg.scene import Scene\nfrom ..regions import Regions\nimport mvseg.demo"),
        ("mvseg.cli.infer", "import mvseg\nfrom mvseg.pipeline import run_scene\nfrom .batch import run_batch"),
    ],
)
def test_imports_from_above_are_fine(module: str, source: str) -> None:
    assert forbidden_rooms(source, module) == set()


def test_other_floors_are_one_way_too() -> None:
    assert forbidden_rooms("from ...results import folder", "mvseg.matching.nview.search") == {"results"}
    assert forbidden_rooms("from mvseg.cli import main", "mvseg.__init__") == {"cli"}
    assert forbidden_rooms("from mvseg.regions import Regions", "mvseg.scene") == {"regions"}
    assert forbidden_rooms("import mvseg", "mvseg.pipeline.run_scene") == {"__init__"}


def test_warnings_are_given_by_one_function() -> None:
    """A `stacklevel` that is counted by hand names a line of mvseg as soon as a call is moved."""
    by_hand = {module for module, source in MODULES.items() if re.search(r"stacklevel|warnings\.warn\b", source)}
    assert by_hand == {"mvseg.errors"}


# Rooms whose numbers stand in their `numbers.py`; and modules of them with what a file format or a drawing defines.
NUMBERED = {room_of(module) for module in MODULES if module.endswith(".numbers")}
BESIDE = {"mvseg.poses.photo_files"}


def numbers_at_the_head(source: str) -> set[str]:
    """Names that are set to plain numbers; sentinels are negative, weights beside their features are tuples."""
    pairs = [(s.targets[0], s.value) for s in parse(source).body if isinstance(s, ast.Assign)]
    flat = [pair for target, value in pairs for pair in (
        zip(target.elts, value.elts, strict=True) if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
        else [(target, value)]
    )]  # fmt: skip
    numbers = [t for t, v in flat if isinstance(v, ast.Constant) and type(v.value) in (int, float)]
    return {target.id for target in numbers if isinstance(target, ast.Name)}


def test_numbers_of_a_room_stand_in_one_place() -> None:
    assert numbers_at_the_head("a = 1\nB, C = 0.5, 'x'\nD = -1\nE = (1, 2)") == {"a", "B"}
    heads = {module: numbers_at_the_head(source) for module, source in MODULES.items() if room_of(module) in NUMBERED}
    assert {module for module, names in heads.items() if names} == BESIDE


MOST_NUMBERS, MOST_CHOSEN = 629, 329  # 550 and 200 are where they are to go
WORDS = "definition", "limit", "fitted", "insensitive", "chosen"  # of numbers


def words_of_numbers(source: str, *, fields: bool = False) -> dict[str, str]:
    """{name: comment} of the numbers of a module, in the line or right above it; `fields` are those of classes."""
    lines, tree = source.splitlines(), parse(source)
    plain = re.compile(r"(?=.*\d)[-+*/(),. \d<e]+")
    nodes = [node for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)
             and node.value is not None and plain.fullmatch(ast.unparse(node.value))]  # fmt: skip
    if fields:
        nodes += [node for each in tree.body if isinstance(each, ast.ClassDef) for node in each.body
                  if isinstance(node, ast.AnnAssign) and node.value is not None]  # fmt: skip
    found = {}
    for node in nodes:
        above = node.lineno - 1
        while above and lines[above - 1].lstrip().startswith("#"):
            above -= 1
        told = [*lines[node.lineno - 1 : node.end_lineno], *lines[above : node.lineno - 1]]
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        found[ast.unparse(target)] = " ".join(re.findall(r"# (?!fmt)(.*)", "\n".join(told)))
    return found


def test_the_comment_of_a_number_begins_with_one_of_five_words() -> None:
    """A number that was fitted names the command that fits it."""
    found = words_of_numbers("A = 1  # limit: x\n# chosen: y\n# z\nB = (1, -2)\nC = 'text'\nD = 2 * 3")
    assert found == {"A": "limit: x", "B": "chosen: y z", "D": ""}
    numbers = {
        (module, name): comment
        for module, source in MODULES.items()
        for name, comment in words_of_numbers(source, fields=module.endswith(".numbers")).items()
    }
    assert len(numbers) <= MOST_NUMBERS, "a number less, or a reason in CONTRIBUTING.md"
    assert sum(comment.startswith("chosen") for comment in numbers.values()) <= MOST_CHOSEN
    assert [place for place, comment in numbers.items() if comment.split(":")[0].split(",")[0] not in WORDS] == []
    fitted = [comment for comment in numbers.values() if comment.startswith("fitted")]
    assert [comment for comment in fitted if not re.search(r"python|the same", comment)] == []


def typed_homes(package: str) -> dict[str, str]:
    """Public name -> module, from the imports in the package's `__init__.py` that only type checkers read."""
    (block,) = [node for node in parse(MODULES[f"{package}.__init__"]).body if isinstance(node, ast.If)]
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {str(name.asname): str(node.module) for node in imports for name in node.names}


@pytest.mark.parametrize("package", [mvseg, mvseg.matching], ids=lambda package: package.__name__)
def test_public_names_come_from_where_type_checkers_look(package: ModuleType) -> None:
    homes = typed_homes(package.__name__)
    assert sorted(homes) == sorted(package.__all__)
    assert homes.pop("__version__", "mvseg._version") == "mvseg._version"  # text, which has no module
    for _ in range(2):  # by the second time all modules are imported: none may hide a function of its name
        assert {name: inspect.unwrap(getattr(package, name)).__module__ for name in homes} == homes
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        package.nothing  # noqa: B018


def test_importing_the_package_is_cheap() -> None:
    code = "import sys, mvseg, mvseg.cli; sys.exit(int('torch' in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_importing_the_name_alone_takes_no_time() -> None:
    slow = {"typing", "importlib.metadata", "mvseg._version"}
    code = f"import sys, mvseg; sys.exit(len({slow} & {{*sys.modules}}))"
    assert subprocess.run([sys.executable, "-S", "-c", code], cwd=ROOT, check=False).returncode == 0


def test_changed_code_has_another_hash(tmp_path: Path) -> None:
    """Also in a checkout that has moved on since it was installed, and without git."""

    def note() -> str:
        return code_hash.__wrapped__(tmp_path)

    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "step.py").write_text("x = 1")
    (tmp_path / "page.html").write_text("<p>")
    hashes = [note()]
    for change in (
        lambda: (tmp_path / "room" / "step.py").write_text("x = 2"),
        lambda: (tmp_path / "page.html").write_text("<b>"),
        lambda: (tmp_path / "room" / "other.py").touch(),
        lambda: (tmp_path / "room" / "other.py").rename(tmp_path / "other.py"),
    ):
        change()
        hashes.append(note())
    assert len({*hashes}) == 5
    (tmp_path / "notes.txt").touch()
    (tmp_path / "room" / "__pycache__").mkdir()
    (tmp_path / "room" / "__pycache__" / "step.pyc").touch()
    assert note() == hashes[-1]
    assert re.fullmatch("[0-9a-f]{16}", code_hash())
    assert made_by() == {"mvseg": mvseg.__version__, "code": code_hash()}


def test_sources_that_nobody_installed_have_a_version(tmp_path: Path) -> None:
    shutil.copytree(PACKAGE, tmp_path / "mvseg", ignore=shutil.ignore_patterns("demo_plant", "__pycache__"))
    code = "import mvseg, mvseg._version; print(mvseg.__version__, mvseg._version.code_hash())"
    said = subprocess.run([sys.executable, "-S", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["0+unknown", code_hash()]


@pytest.mark.slow
def test_both_doors_have_an_example_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages = [(ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/detector.md")]
    examples = [example for page in pages for example in re.findall(r"```python\n(.*?)```", page, re.DOTALL)]
    assert len(examples) == 2
    monkeypatch.chdir(tmp_path)
    masks_given, masks_found = scopes = [{}, {}]
    for example, scope in zip(examples, scopes, strict=True):
        assert len(example.strip().splitlines()) <= 20
        exec(compile(example, "README.md", "exec"), scope)
    assert masks_given["matching"].num_instances == 12
    assert (tmp_path / "leaf_1.ply").is_file()
    sizes = [len(view["instance_ids"]) for view in masks_found["detections"]]
    assert sizes == [len(view["masks"]) for view in masks_found["detections"]]
    assert len(sizes) == 9
    assert sum(sizes) >= 85  # of 108 visible leaves


# Links of Markdown, and paths in it that start at the root, but for those of a commit (`git show COMMIT:PATH`).
PATHS = re.compile(r"\]\(([^)#]+)|(?<!:)\b((?:mvseg|benchmarks|configs|docs|models|tests)/[\w/.-]+\.\w+)")
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/notes/*.md"), *ROOT.glob("models/**/*.md")]


def test_files_that_the_documents_name_are_there() -> None:
    absent = []
    for page in PAGES:
        for link, path in PATHS.findall(page.read_text(encoding="utf-8")):
            target = page.parent / link if link else ROOT / path
            if not link.startswith("http") and not target.exists():
                absent.append((page.relative_to(ROOT).as_posix(), link or path))
    assert absent == []


def test_every_promise_names_tests_that_exist() -> None:
    lines = (ROOT / "docs" / "notes" / "reliability.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if line.startswith("| ")][1:]  # without the header
    assert len(rows) > 10
    named = [re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", row) for row in rows]
    assert [row for row, tests in zip(rows, named, strict=True) if not tests] == []
    for file, name in [test for tests in named for test in tests]:
        text = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"^ *def {name}\(", text, re.MULTILINE), (file, name)


def test_every_format_names_a_test() -> None:
    lines = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8").splitlines()
    tables = "\n".join(line if line.startswith("|") else "" for line in lines).split("\n\n")
    rows = [row for table in tables if "tested with" in table for row in table.strip().splitlines()[2:]]
    assert len(rows) > 15
    assert [row for row in rows if not re.search(r"\((`tests/[\w/]+\.py`(, )?)+\) \|$", row)] == []


@pytest.mark.slow
def test_wheel_holds_one_package_with_the_shipped_scene(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    (about,) = [name for name in names if name.endswith(".dist-info/METADATA")]
    readme = zipfile.ZipFile(wheel).read(about).decode().split("\n\n", 1)[1]
    links = re.findall(r"\]\(([^)#]+)", readme)
    assert any(link.endswith("/raw/main/docs/demo.jpg") for link in links)
    assert [link for link in links if not link.startswith("https://")] == []
    top = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert top == {"mvseg"}
    assert {"mvseg/demo_plant/cameras.json", "mvseg/py.typed", "mvseg/zoo/leaf-lite/weights.safetensors"} <= set(names)
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    code = "from mvseg.cli.options import find_config as find; print(find('paper.yaml'), find('train/rosettes.yaml'))"
    where = {**os.environ, "PYTHONPATH": str(tmp_path / "installed")}
    command = [sys.executable, "-c", code]
    said = subprocess.run(command, cwd=tmp_path, env=where, check=True, capture_output=True, text=True)
    home = tmp_path / "installed" / "mvseg" / "configs"
    assert said.stdout.split() == [str(home / "paper.yaml"), str(home / "train" / "rosettes.yaml")]
    assets = (PACKAGE / "results" / "report" / "assets").rglob("*")
    assert {file.relative_to(ROOT).as_posix() for file in assets if file.is_file()} <= set(names)


def test_the_projects_address_is_set_in_one_place() -> None:
    """Links among the project's own files are relative."""
    hooks = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["metadata"]["hooks"]
    address = hooks["custom"]["repository"]
    folders = [ROOT / name for name in (".ci", ".github", "mvseg", "docs")]
    files = [path for path in (*ROOT.glob("*"), *(each for folder in folders for each in folder.rglob("*")))]
    texts = [path for path in files if path.suffix in (".py", ".md", ".toml", ".yml", ".yaml", ".cff", ".ipynb")]
    named = {path.name for path in texts if address in path.read_text(encoding="utf-8")}
    assert named == {"pyproject.toml"}


def test_the_conda_recipe_wants_what_the_package_wants() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    recipe = yaml.safe_load((ROOT / ".ci" / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    conda_names = {"torch": "pytorch", "opencv-python-headless": "py-opencv"}
    pairs = [wanted.split(">=") for wanted in project["dependencies"]]
    expected = {f"{conda_names.get(name, name).partition('[')[0]} >={version}" for name, version in pairs}
    assert expected <= set(recipe["requirements"]["run"])


def test_shipped_scene_is_small() -> None:
    for name, most in (("demo_plant", 3_000_000), ("demo_plant_later", 500_000)):
        assert sum(file.stat().st_size for file in (PACKAGE / name).rglob("*") if file.is_file()) <= most


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "write"), [("demo_plant", write_demo_plant), ("demo_plant_later", write_demo_plant_later)]
)
def test_shipped_masks_are_what_the_script_makes(name: str, write: Callable[[Path], None], tmp_path: Path) -> None:
    write(tmp_path / "plant")
    shipped = sorted((PACKAGE / name).rglob("*.png"))
    assert len(shipped) == 18
    for file in shipped:
        assert (tmp_path / "plant" / file.relative_to(PACKAGE / name)).read_bytes() == file.read_bytes()


@pytest.mark.parametrize("config", sorted((ROOT / "configs").rglob("*.yaml")), ids=lambda path: path.name)
def test_published_configs_are_understood(config: Path) -> None:
    """Unknown keys, wrong types and values out of range are errors."""
    verb = "train" if config.parent.name == "train" else "infer"
    args = command.build_parser().parse_args([verb, "--config", str(config)])[verb]
    if verb == "train":
        TrainConfig(**{field.name: args[field.name] for field in fields(TrainConfig)})
        return
    kinds = {"match": mvseg.MatchConfig, "detect": mvseg.DetectConfig, "reconstruct": mvseg.ReconstructConfig,
             "traits": mvseg.TraitsConfig}  # fmt: skip
    for name, settings in yaml.safe_load(config.read_text(encoding="utf-8")).items():
        assert kinds[name](**vars(args[name])) == kinds[name](**settings) != kinds[name]()
