"""The networks that come with facepipe, small ONNX files trained on renders of synthetic heads by `training/`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.networks.face_search import FoundFace, find_landmarks, follow_face
    from facepipe.networks.files import feature_model, landmark_model
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["FoundFace", "feature_model", "find_landmarks", "follow_face", "landmark_model"]
