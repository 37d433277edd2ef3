"""The stage: the only door between USD and numpy."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.stage.author import save_parts
    from facepipe.stage.face import Face, open_face
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Face", "open_face", "save_parts"]
