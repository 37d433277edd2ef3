"""The networks that come with facepipe, small ONNX files trained on renders of synthetic heads by `training/`."""

from __future__ import annotations

from facepipe.learn.networks.face_search import FoundFace, find_landmarks
from facepipe.learn.networks.files import landmark_model

__all__ = ["FoundFace", "find_landmarks", "landmark_model"]
