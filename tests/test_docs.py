"""The documents: notebooks run, the site is built from files alone, and nothing public is left out."""

from __future__ import annotations

import inspect
import os
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import mvseg
import mvseg.matching
from mvseg.cli.command import build_parser
from mvseg.cli.options import find_config
from mvseg.errors import InputError

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
MEASURED = re.compile(r"(\d+(?:\.\d+)?) \+- (\d+(?:\.\d+)?)")
# what a browser fetches by itself
LOADED = re.compile(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"?([^\s\">]+)|<link\b[^>]*>|url\(([^)]+)\)")


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The hooks of the site."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("nbconvert")
    monkeypatch.syspath_prepend(str(ROOT / ".ci"))
    return import_module("mkdocs_pages")


@pytest.mark.skipif(shutil.which("Rscript") is None, reason="R is not installed")
def test_the_code_for_r_runs(tmp_path: Path) -> None:
    numbers = [["scene", "plant", "time", "treatment", "leaf", "trait", "value", "sd", "unit", "method", "ontology"]]
    leaves = [["scene", "plant", "time", "treatment", "leaf", "area", "area_sd", "unit", "method", "quality"]]
    for plant in range(8):
        for day in range(4):
            area = (1000 + 30 * plant) * (1 + day / (8 if plant % 2 else 5)) + 7 * (plant * day % 3)
            row = [f"{day}_{plant}", plant, f"2026-05-0{day + 1}", "dry" if plant % 2 else "wet"]
            numbers.append([*row, "", "total_leaf_area", area, 9, "mm^2", "surface", ""])
            leaves.append([*row, 1, area / 2, 5, "mm", "surface", "good"])
    for name, rows in (("traits", numbers), ("traits_wide", leaves)):
        path = tmp_path / "night" / "tables" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    (code,) = re.findall(r"```r\n(.*?)```", (DOCS / "data-out.md").read_text(encoding="utf-8"), re.DOTALL)
    ran = subprocess.run(["Rscript", "-"], input=code, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "day:treatmentwet" in ran.stdout
    assert (tmp_path / "growth.png").stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_and_print_what_they_show(path: Path, tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    runner = tmp_path / "run.py"  # a process of its own: Jupyter's event loop leaves warnings behind
    runner.write_text(
        "import nbclient, nbformat, sys\n"
        "book = nbformat.read(sys.argv[1], 4)\n"
        "nbclient.NotebookClient(book, timeout=600, kernel_name='python3').execute()\n"
        "nbformat.write(book, sys.argv[2])\n"
    )
    command = [sys.executable, str(runner), str(path), str(tmp_path / "run.ipynb")]
    subprocess.run(command, check=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True)
    shown, printed = (_text_outputs(nbformat.read(each, 4)) for each in (path, tmp_path / "run.ipynb"))
    assert any(shown)
    for new, old in zip(printed, shown, strict=True):
        assert_alike(new, old)


def assert_alike(printed: str, shown: str) -> None:
    """The same text; numbers with a standard deviation differ by less than that, as processors round differently."""
    assert MEASURED.sub("", printed) == MEASURED.sub("", shown)
    for new, old in zip(MEASURED.findall(printed), MEASURED.findall(shown), strict=True):
        (value, sd), (other, other_sd) = map(float, new), map(float, old)
        assert abs(value - other) < other_sd
        assert sd == pytest.approx(other_sd, rel=0.25)


def _text_outputs(book: Any) -> list[str]:
    cells = [cell for cell in book.cells if cell.cell_type == "code"]
    return ["".join(output.get("text", "") for output in cell.outputs) for cell in cells]


def test_every_public_name_is_on_the_page() -> None:
    listed = re.findall(r"^::: mvseg\.(\w+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(set(mvseg.__all__) - {"__version__"})
    assert set(mvseg.matching.__all__) <= set(listed)


def test_the_reference_says_in_a_line_what_each_name_does() -> None:
    """For those who read it without a build; the first sentence of its docstring."""
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    for name in re.findall(r"^::: mvseg\.(\w+)$", page, re.MULTILINE):
        text = (inspect.getdoc(getattr(mvseg, name)) or "").strip()
        first = re.split(r"\n\n|(?<=[.])\s+(?=[A-Z])", text, maxsplit=1)[0].rstrip(".:;")
        first = first.replace("\n", " ").replace("|", "\\|")
        assert f"| `{name}` | {first} |" in page


# Names of other programs and files, examples of names, and columns of which the code has the first part only.
ELSEWHERE = {"NA", "PIP_EXTRA_INDEX_URL", "SamAutomaticMaskGenerator", "cProfile", "compound_leaf", "data_file"}
ELSEWHERE |= {"estimate_sim3d", "j_from_world", "kapture_mast3r_mapping.py", "px_from_cam"}
ELSEWHERE |= {"DataFrame", "save_conf", "shapes_to_label"}
QUOTED = re.compile(r"`(?:[\w.]+/)*([A-Za-z_][\w.]*)(?:\(.*?\))?`")
DOCSTRING = re.compile(r'""".*?"""', re.DOTALL)


def test_names_in_backticks_are_in_the_code() -> None:
    """In pages and in docstrings: of files, and identifiers that no English word looks like; of dotted names, each
    part."""
    sources = [path for room in ("mvseg", "benchmarks", "tests", "docs") for path in (ROOT / room).rglob("*.py")]
    known, texts = {path.name for path in sources} | ELSEWHERE, {}
    for path in sources:
        source = path.read_text(encoding="utf-8")
        known |= {path.stem, path.parent.name, *re.findall(r"\w+", re.sub("#.*", "", DOCSTRING.sub("", source)))}
        texts[path.relative_to(ROOT).as_posix()] = "\n".join(DOCSTRING.findall(source))
    pages = [path for path in (*ROOT.glob("*.md"), *DOCS.glob("*.md"), *DOCS.glob("notes/*.md"))]
    texts |= {page.name: page.read_text(encoding="utf-8") for page in pages if page.name != "CHANGELOG.md"}
    for place, text in texts.items():
        quoted = QUOTED.findall(text)
        files = {name for name in quoted if name.endswith(".py")}
        parts = {part for name in {*quoted} - files for part in name.split(".")}
        identifiers = {part for part in parts if re.search(r"[a-z]_[a-z]|[a-z][A-Z]|^[A-Z][A-Z_]+$", part)}
        assert (files | identifiers) - known == set(), place


def test_pages_that_nobody_listed_are_shown(pages: ModuleType) -> None:
    nav = pages.order_pages(["guide.md", "index.md", "harvest.md", "api.md"])
    assert nav == [{"Start": ["index.md", "guide.md"]}, {"How to": ["harvest.md"]}, {"Reference": ["api.md"]}]
    missing = {page for wanted in pages.ORDER.values() for page in wanted} - {"index.md"}
    missing -= {path.relative_to(DOCS).with_suffix(".md").as_posix() for path in DOCS.rglob("*.*")}
    assert missing == set()


def test_a_how_to_fits_on_two_screens(pages: ModuleType) -> None:
    """About: by its words. Details belong to the reference, and measurements to notes."""
    texts = {page: (DOCS / page).read_text(encoding="utf-8") for page in ("guide.md", *pages.ORDER["How to"])}
    assert {page: num for page, text in texts.items() if (num := len(text.split())) > 700} == {}


def test_the_site_of_a_release_has_its_own_address(pages: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    config = SimpleNamespace(site_name="mvseg", site_url=None)
    assert pages.on_config(config).site_url is None
    monkeypatch.setattr(pages, "VERSION", "0.2.0")
    said = pages.on_config(config)
    assert (said.site_name, said.site_url) == ("mvseg 0.2.0", "https://mvseg.github.io/mvseg/0.2.0/")


def test_the_first_page_links_into_the_site(pages: ModuleType) -> None:
    links = re.findall(r"\]\(([^)#]+)", pages.first_page())
    assert "demo.jpg" in links
    assert "matching.md" in links
    inside = [link for link in links if not link.startswith("http")]
    assert [link for link in inside if not (DOCS / link).is_file()] == []
    outside = [link.removeprefix(pages.SOURCE) for link in links if link.startswith(pages.SOURCE)]
    assert [link for link in outside if not (ROOT / link).exists()] == []


@pytest.mark.slow
def test_the_site_is_built_and_loads_nothing_from_elsewhere(pages: ModuleType, tmp_path: Path) -> None:
    # not --quiet: it keeps warnings, links without an anchor among them, from being counted as errors
    command = ["build", "--strict", "--config-file", str(ROOT / ".ci" / "mkdocs.yml"), "--site-dir"]
    where = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    site = tmp_path / "site"
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", *command, str(site)], env=where, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    built = {path.relative_to(site).as_posix() for path in site.rglob("*.html")}
    assert {"index.html", "guide/index.html", "api/index.html", "notebooks/own_arrays/index.html"} <= built
    loaded = set()
    for path in [*site.rglob("*.html"), *site.rglob("*.css")]:
        for found in LOADED.finditer(path.read_text(encoding="utf-8")):
            if found[0].startswith("<link") and "stylesheet" not in found[0] and "preload" not in found[0]:
                continue
            loaded.add(found[1] or found[2] or found[0])
    assert len(loaded) > 5
    assert [each for each in loaded if "//" in each and "http://www.w3.org" not in each] == []
    assert "match_regions" in (site / "api" / "index.html").read_text(encoding="utf-8")


def test_the_image_is_made_of_files_that_are_there() -> None:
    lines = (ROOT / ".ci" / "Dockerfile").read_text(encoding="utf-8").splitlines()
    copied = {source for line in lines if line.startswith("COPY ") for source in line.split()[1:-1]}
    assert {path for path in copied if not (ROOT / path).exists()} == set()
    allowed = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert {path.removeprefix("./") for path in copied} == {line[1:] for line in allowed if line.startswith("!")}
    assert {"pyproject.toml", "hatch_build.py", "README.md", "LICENSE", "mvseg", "models", "configs"} == copied


def test_shipped_configs_have_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_config("paper.yaml") == ROOT / "configs" / "paper.yaml"
    assert build_parser().parse_args(["infer", "--config", "paper.yaml"]).infer.match.num_points == 200
    assert find_config("train/rosettes.yaml") == ROOT / "configs" / "train" / "rosettes.yaml"
    shutil.copy(ROOT / "configs" / "train" / "rosettes.yaml", "paper.yaml")
    assert find_config("paper.yaml") == Path("paper.yaml")  # one's own come first
    for name in ("absent.yaml", "../pyproject.toml", "/absent.yaml"):
        with pytest.raises(InputError, match=r"no such file.*: paper\.yaml, train/finetune-coco\.yaml"):
            find_config(name)
