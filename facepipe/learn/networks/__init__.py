"""The networks that come with facepipe, small ONNX files trained on renders of synthetic heads by `training/`."""

from __future__ import annotations

from facepipe.learn.networks.face_search import FoundFace, find_landmarks
from facepipe.learn.networks.files import feature_model, landmark_model
from facepipe.learn.networks.own_extractors import own_extractors

__all__ = ["FoundFace", "feature_model", "find_landmarks", "landmark_model", "own_extractors"]
