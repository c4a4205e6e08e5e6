"""What the package's metadata say about addresses: the project's own, and links of the README that lead to its files.

`repository` in pyproject.toml, under [tool.hatch.metadata.hooks.custom], is the one place where the address is set.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)]+)\)")


class Addresses(MetadataHookInterface):
    def update(self, metadata: dict[str, Any]) -> None:
        """Set `urls`, and `readme` with absolute links."""
        home = self.config["repository"]
        metadata["urls"] = {
            "Homepage": home,
            "Source": home,
            "Documentation": f"{home}/tree/main/docs",
            "Changelog": f"{home}/blob/main/CHANGELOG.md",
            "Issues": f"{home}/issues",
        }
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": absolute_links(text, home)}


def absolute_links(text: str, home: str) -> str:
    """Markdown whose relative links and pictures lead into the repository at `home`."""

    def lead(link: re.Match[str]) -> str:
        kind = "raw" if link[1] else "blob"
        return f"{link[1]}[{link[2]}]({home}/{kind}/main/{link[3]})"

    return LINK.sub(lead, text)
