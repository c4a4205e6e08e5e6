"""Which photos a person draws a leaf in, who draws it in few of them."""

from __future__ import annotations

import numpy as np

from benchmarks.corrections import Case

OPEN = 0.5  # of the pixels of the photo that shows most of a leaf: those with more show it openly


def open_views(visible: np.ndarray) -> list[int]:
    """The views that show a leaf openly, by its visible pixels (V,) in each; the largest first."""
    order = np.argsort(-visible, kind="stable")
    return [int(view) for view in order if visible[view] >= OPEN * visible.max() > 0]


def draw_from(case: Case, views: list[int], number: int) -> list[int]:
    """The first view, and then those from the most different sides."""
    centers = case.plant.scene.cameras.centers.numpy()
    sights = centers - centers.mean(0)
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    chosen = [views[0]]
    while len(chosen) < min(number, len(views)):
        left = [view for view in views if view not in chosen]
        nearest = (sights[left] @ sights[chosen].T).max(1)
        chosen.append(left[int(np.round(nearest, 6).argmin())])
    return chosen
