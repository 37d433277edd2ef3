"""Recipes of a rebuild's stages as the release before wrote them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from facepipe.parts import Recipe

QUALITY = {"surface_mean_mm": 0.1, "surface_p95_mm": 0.4, "coverage": 0.9, "flipped_triangles": 3}


def old_recipe(verb: str, files: Mapping[str, str | Sequence[str]], **more: object) -> Recipe:
    """A recipe of a stage that stands beside its `files`."""
    seen = {name: f"./{one}" if isinstance(one, str) else [f"./{each}" for each in one] for name, one in files.items()}
    sources = [one for each in seen.values() for one in ([each] if isinstance(each, str) else each)]
    options = {"files": seen, "quality": QUALITY, **more}
    return Recipe(
        verb=verb, sources=tuple(sources), digests=("sha256:0",) * len(sources), options=options, version="0.1.0"
    )
