"""Photo fit: the photo and its landmarks in, a face with fitted sliders out."""

from facepipe.processors.photo_fit.landmark_file import read_landmarks, write_landmarks
from facepipe.processors.photo_fit.landmarker import mediapipe_landmarks, own_landmarks
from facepipe.processors.photo_fit.landmarks68 import Landmarks68
from facepipe.processors.photo_fit.photo_file import Photo, read_photo

__all__ = [
    "Landmarks68",
    "Photo",
    "mediapipe_landmarks",
    "own_landmarks",
    "read_landmarks",
    "read_photo",
    "write_landmarks",
]
