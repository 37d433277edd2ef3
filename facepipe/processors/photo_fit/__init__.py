"""Photo fit: the photo and its landmarks in, a face with fitted sliders out."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.processors.photo_fit.author import AuthorPhotoFit
    from facepipe.processors.photo_fit.fit_photo_action import FitPhoto
    from facepipe.processors.photo_fit.landmark_file import read_landmarks, write_landmarks
    from facepipe.processors.photo_fit.masks import FaceMask, face_mask
    from facepipe.processors.photo_fit.photo_file import Photo, read_photo
    from facepipe.processors.photo_fit.photo_landmarks import Landmarks68, mediapipe_landmarks, own_landmarks
    from facepipe.processors.photo_fit.plausible_landmarks import check_face
    from facepipe.processors.photo_fit.report import PhotoFitReport, PhotoReport
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "AuthorPhotoFit",
    "FaceMask",
    "FitPhoto",
    "Landmarks68",
    "Photo",
    "PhotoFitReport",
    "PhotoReport",
    "check_face",
    "face_mask",
    "mediapipe_landmarks",
    "own_landmarks",
    "read_landmarks",
    "read_photo",
    "write_landmarks",
]
