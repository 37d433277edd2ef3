"""Short videos of one person: the frames that a photo fit learns most from."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.photo.frames.choose_frames_action import ChooseFrames
    from facepipe.photo.frames.report import ChosenFrame, ChosenFramesReport
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["ChooseFrames", "ChosenFrame", "ChosenFramesReport"]
