"""What the site shows beside the pages of docs/: the README as its first page, the notebooks, and an order of all."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Any

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
REPOSITORY = PROJECT["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
VERSION = os.environ.get("DOCS_VERSION", "")  # of a release, whose site keeps its address; "" for a site of one's own
SOURCE = f"{REPOSITORY}/blob/{'v' + VERSION if VERSION else 'main'}/"
# Pages in the order of the site; those that are not there are left out, and those that are not listed come last.
ORDER = {
    "Start": ("index.md", "guide.md", "glossary.md"),
    "How to": (  # at most two screens each; tests/test_docs.py counts their words
        "pose.md",
        "scale.md",
        "turntable.md",
        "own-cameras.md",
        "own-masks.md",
        "recipes.md",
        "check.md",
        "corrections.md",
        "tracking.md",
        "batch.md",
        "cluster.md",
        "fine-tune.md",
        "data-out.md",
    ),
    "Notebooks": ("notebooks/demo_plant.md", "notebooks/own_arrays.md"),
    "Reference": ("results.md", "traits.md", "formats.md", "api.md"),
    "How it works": ("detector.md", "matching.md", "surfaces.md"),
    "How well it works": ("gallery.md", "benchmarks.md", "performance.md", "reliability.md"),
    "Notes: measurements": (
        "notes/matching.md",
        "notes/surfaces.md",
        "notes/traits.md",
        "notes/detector.md",
        "notes/check.md",
        "notes/pose.md",
        "notes/corrections.md",
        "notes/tracking.md",
        "notes/performance.md",
        "notes/reliability.md",
    ),
}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The site of a release says which, and knows its own address."""
    if VERSION:
        owner, name = REPOSITORY.split("/")[-2:]
        config.site_name = f"mvseg {VERSION}"
        config.site_url = f"https://{owner}.github.io/{name}/{VERSION}/"
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the README as index.md and a page per notebook."""
    files.append(File.generated(config, "index.md", content=first_page()))
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        for name, content in notebook_page(path).items():
            files.append(File.generated(config, name, content=content))
    config.nav = order_pages([file.src_uri for file in files.documentation_pages()])
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links to notebooks lead to their pages."""
    return markdown.replace(".ipynb)", ".md)")


def first_page() -> str:
    """The README with the links of the site: to its own pages and pictures, and to the source for all other files."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    return re.sub(r"\]\((?!https?:|#)([^)]+)\)", lambda link: f"]({_site_link(link[1])})", text)


def _site_link(link: str) -> str:
    return link if (ROOT / "docs" / link.partition("#")[0]).exists() else SOURCE + link


def notebook_page(path: Path) -> dict[str, str | bytes]:
    """A notebook with its stored outputs as a page, and its pictures: names below docs/ and their content."""
    name = f"notebooks/{path.stem}"
    text, resources = MarkdownExporter().from_notebook_node(
        nbformat.read(path, as_version=4), {"output_files_dir": path.stem, "unique_key": path.stem}
    )
    return {f"{name}.md": text} | {f"notebooks/{key}": value for key, value in resources["outputs"].items()}


def order_pages(pages: list[str]) -> list[dict[str, Any]]:
    """The navigation."""
    sections: dict[str, list[str]] = {
        title: [page for page in wanted if page in pages] for title, wanted in ORDER.items()
    }
    listed = {page for wanted in sections.values() for page in wanted}
    sections["How to"] += sorted(set(pages) - listed)
    return [{title: list(wanted)} for title, wanted in sections.items() if wanted]
