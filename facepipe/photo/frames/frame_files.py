"""Chosen frames as files, and whether a photo fit can take them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from PIL import Image

from facepipe.core.errors import InputError
from facepipe.photo.fit import own_landmarks, read_photo
from facepipe.photo.frames.choice import angles, relative_sharpness
from facepipe.photo.frames.clip import Clip
from facepipe.photo.frames.look import Look
from facepipe.photo.frames.report import ChosenFrame, ChosenFramesReport
from facepipe.photo.frames.search import Looks
from facepipe.pictures import save_png

_ONE_SIDE = 15.0  # degrees between the two farthest frames


def write_frames(
    clip: Clip, seen: Looks, kept: Sequence[int], folder: Path, done: Callable[[], object]
) -> ChosenFramesReport:
    """Write the frames of some looks into a folder as PNG.

    :param kept: indices of looks, in their order
    :raises InputError: the clip can't be read
    """
    sharp, chosen, warnings = relative_sharpness(seen.looks), list[ChosenFrame](), list[str]()
    wanted = {seen.looks[index].number: index for index in kept}
    last = max(wanted)
    for frame in clip.frames():
        if frame.number in wanted:
            index = wanted[frame.number]
            look, name = seen.looks[index], f"frame_{frame.number:05d}_{frame.time:.2f}s.png"
            save_png(Image.fromarray(frame.picture()), folder / name)
            chosen.append(_chosen(look, name, float(sharp[index])))
            warnings += _refused(folder / name)
            done()
        if frame.number >= last:
            break
    if len(chosen) != len(wanted):
        raise InputError(clip.path, "was changed while it was read")
    return ChosenFramesReport(
        chosen=tuple(chosen),
        clip_frames=seen.frames,
        clip_seconds=round(seen.seconds, 3),
        looked_at=seen.tried,
        with_face=len(seen.looks),
        warnings=(*_one_side([seen.looks[index] for index in kept]), *warnings),
    )


def _chosen(look: Look, name: str, sharpness: float) -> ChosenFrame:
    return ChosenFrame(
        file=name,
        number=look.number,
        time=round(look.time, 3),
        sharpness=round(sharpness, 3),
        yaw=round(look.yaw, 4),
        pitch=round(look.pitch, 4),
    )


def _refused(file: Path) -> list[str]:
    """Why `facepipe fit-photo` would not take a frame as it is: another face, or landmarks that can't be right."""
    try:
        own_landmarks(read_photo(file))
    except InputError as error:
        return [f"{file.name}: for fit-photo {error.what}"]
    return []


def _one_side(looks: Sequence[Look]) -> list[str]:
    widest = float(angles(looks).max())
    if widest >= _ONE_SIDE:
        return []
    return [f"the head turns by {widest:.0f} degrees only: frames from several sides give a better person"]
