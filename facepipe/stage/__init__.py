"""The stage: the only door between USD and numpy."""

from facepipe.stage.author import save_parts
from facepipe.stage.face import Face, open_face

__all__ = ["Face", "open_face", "save_parts"]
