"""Photo fit: the photo and its landmarks in, a face with fitted sliders out."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.photo.fit.author import AuthorPhotoFit
    from facepipe.photo.fit.fit_photo_action import FitPhoto
    from facepipe.photo.fit.photo_file import Photo, read_photo
    from facepipe.photo.fit.photo_landmarks import (
        Landmarks68,
        check_face,
        mediapipe_landmarks,
        own_landmarks,
        read_landmarks,
        write_landmarks,
    )
    from facepipe.photo.fit.report import PhotoFitReport, PhotoReport
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "AuthorPhotoFit",
    "FitPhoto",
    "Landmarks68",
    "Photo",
    "PhotoFitReport",
    "PhotoReport",
    "check_face",
    "mediapipe_landmarks",
    "own_landmarks",
    "read_landmarks",
    "read_photo",
    "write_landmarks",
]
