"""Texture files beside a stage."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from facepipe.atomic import write_bytes
from facepipe.errors import InputError

_IMAGE_STARTS = (
    b"\x89PNG\r\n\x1a\n",
    b"\xff\xd8\xff",
    b"BM",
    b"RIFF",
    b"II*\x00",
    b"MM\x00*",
    b"v/1\x01",
    b"#?RADIANCE",
)


def is_image(data: bytes) -> bool:
    """Whether bytes begin as an image does. Only images are copied or exported, whatever file a stage names."""
    return data.startswith(_IMAGE_STARTS)


class TextureFolder:
    """The folder ``<stem>_textures`` beside a stage file, made only if there are textures to write.

    A file that is there with other content is never overwritten: another stage may show it.
    """

    def __init__(self, stage_file: Path) -> None:
        self._folder = stage_file.parent / f"{stage_file.stem}_textures"
        self._files: dict[Path, bytes] = {}

    def add(self, name: str, data: bytes) -> str:
        """Take a texture; its asset path as the stage file names it."""
        wanted = self._folder / Path(name).name
        file, number = wanted, 1
        while not self._has_place(file, data):
            number += 1
            file = wanted.with_name(f"{wanted.stem}_{number}{wanted.suffix}")
        self._files[file] = data
        return f"./{self._folder.name}/{file.name}"

    def write(self) -> None:
        """Write what was taken.

        :raises InputError: the folder can't be written
        """
        for file, data in self._files.items():
            if not self._folder.parent.is_dir():
                raise InputError(self._folder.parent, "no such folder")
            self._folder.mkdir(exist_ok=True)
            if not file.exists():
                write_bytes(file, data)

    def _has_place(self, file: Path, data: bytes) -> bool:
        if file in self._files:
            return self._files[file] == data
        return not file.exists() or file.read_bytes() == data


@contextlib.contextmanager
def texture_home(target: Path) -> Iterator[Path]:
    """The stage file that textures go beside: `target`, or for a .usdz one in a passing folder that it is packed from.

    :raises InputError: the folder of `target` does not exist
    """
    if target.suffix.lower() != ".usdz":
        yield target
        return
    if not target.parent.is_dir():
        raise InputError(target, "the folder does not exist")
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".facepipe-") as folder:
        yield Path(folder) / target.name
