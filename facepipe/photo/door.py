"""What others find of photo fits by name."""

from __future__ import annotations

from pathlib import Path

NAME = "photos"
FORMER = {
    "facepipe.learn.features": ("facepipe.photo.features",),
    "facepipe.learn.photo": ("facepipe.photo.descent",),
    "facepipe.learn.photo.amortised": ("facepipe.photo.amortised",),
    "facepipe.photo_options": ("facepipe.photo.options",),
    "facepipe.processors.photo_fit": ("facepipe.photo.fit", "facepipe.networks.files"),
    "facepipe.processors.photo_texture": ("facepipe.photo.texture",),
}


def find_landmarks(photo: Path, out: Path) -> None:
    """Write where the landmarks of the one face in a photo are, as ``--landmarks`` of `facepipe fit-photo` reads it.

    :raises InputError: no torch, a file that is no photo, or no or several faces
    """
    from facepipe.photo.fit.photo_file import read_photo
    from facepipe.photo.fit.photo_landmarks import own_landmarks, write_landmarks

    read = read_photo(photo)
    write_landmarks(out, own_landmarks(read), read)
