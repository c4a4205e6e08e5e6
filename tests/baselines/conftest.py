"""The textured scene of these tests, rendered once."""

from __future__ import annotations

import pytest

from leafy_scene import LeafyScene, write_leafy_scene


@pytest.fixture(scope="session")
def leafy(tmp_path_factory: pytest.TempPathFactory) -> LeafyScene:
    return write_leafy_scene(tmp_path_factory.mktemp("leafy"))
