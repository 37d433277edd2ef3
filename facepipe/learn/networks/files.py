"""Where the shipped networks are."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path


def landmark_model() -> Path:
    """The file that finds the 68 landmarks of a face in a crop, and whether there is one."""
    return _own("landmarks.onnx")


def feature_model() -> Path:
    """The file that sees content, identity and attributes in a crop of a face."""
    return _own("face_features.onnx")


def _own(name: str) -> Path:
    return Path(str(files("facepipe.learn.networks") / name))
