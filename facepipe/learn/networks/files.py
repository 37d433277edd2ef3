"""The shipped networks: where they are, and the feature network as extractors."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError

if TYPE_CHECKING:
    from facepipe.learn.features.description import Kind
    from facepipe.learn.features.extractor import Extractor


def own_extractors(kinds: Sequence[Kind]) -> dict[Kind, Extractor]:
    """The extractor of each kind: one network for all, so that one forward serves them.

    :raises InputError: a kind that it does not have
    """
    from facepipe.learn.features.extractor import load_extractor

    loaded = load_extractor(feature_model(), kinds[0]) if kinds else None
    missing = [kind for kind in kinds if loaded is None or kind not in loaded.kinds]
    if missing:
        raise InputError(feature_model(), f"has no {missing[0]}, expected one of {loaded.kinds if loaded else ()}")
    return {kind: loaded for kind in kinds if loaded is not None}


def landmark_model() -> Path:
    """The file that finds the 68 landmarks of a face in a crop, and whether there is one."""
    return _own("landmarks.onnx")


def feature_model() -> Path:
    """The file that sees content, identity and attributes in a crop of a face."""
    return _own("face_features.onnx")


def _own(name: str) -> Path:
    return Path(str(files("facepipe.learn.networks") / name))
