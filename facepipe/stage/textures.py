"""Texture files beside a stage, and stages saved as one file with copies of theirs."""

from __future__ import annotations

import contextlib
import itertools
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

from pxr import Sdf, Usd, UsdUtils

from facepipe.core.atomic import collect, hidden_folder, replacing_folder, together, write_bytes
from facepipe.core.errors import InputError
from facepipe.core.names import file_name
from facepipe.core.policy.paths import check_written
from facepipe.parts import Texture
from facepipe.stage.files import check_suffix, relative_path, save_layer
from facepipe.stage.flattening import flattened
from facepipe.stage.layer_files import name_of
from facepipe.stage.materials import images_of


class TextureFolder:
    """The folder ``<stem>_textures`` beside a stage file, made only if there are textures to write.

    A file that is there with other content is never overwritten: another stage may show it. Names of files
    are plain, whatever the textures are called, and differ in more than case.
    """

    def __init__(self, stage_file: Path) -> None:
        self._folder = texture_folder(stage_file)
        self._files: dict[Path, bytes] = {}
        self._taken: set[str] = set()  # names, without case

    def add(self, name: str, data: bytes) -> str:
        """Take a texture; its asset path as the stage file names it.

        :raises InputError: the folder is a link that leads outside the roots
        """
        wanted = self._folder / file_name(name, "texture")
        check_written(self._folder)  # which nobody typed: as a link it is no folder on the way
        check_written(wanted)
        for number in itertools.count(1):
            file = wanted if number == 1 else wanted.with_name(f"{wanted.stem}_{number}{wanted.suffix}")
            if file.name.casefold() in self._taken:
                has_place = self._files.get(file) == data
            else:
                has_place = not file.exists() or (file.is_file() and file.read_bytes() == data)
            if has_place:
                break
        self._files[file] = data
        self._taken.add(file.name.casefold())
        return f"./{self._folder.name}/{file.name}"

    def write(self) -> None:
        """Write what was taken.

        :raises InputError: the folder can't be written
        """
        if not self._files:
            return
        if not self._folder.parent.is_dir():
            raise InputError(self._folder.parent, "no such folder")
        if not self._folder.exists():
            with replacing_folder(self._folder) as folder:
                for file, data in self._files.items():
                    write_bytes(folder / file.name, data)
        else:
            for file, data in self._files.items():
                if not file.exists():
                    write_bytes(file, data)


class NewTextures:
    """Textures made for a layer that is not saved yet: files in a temporary folder, named by their absolute paths."""

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()
        self.files: dict[str, bytes] = {}  # by the asset path
        self.shown: dict[tuple[str, str], Texture] = {}  # by material and its field

    def __enter__(self) -> NewTextures:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, name: str, data: bytes) -> str:
        """Take a texture; its asset path until the layer is saved."""
        folder = self._stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        file = Path(folder) / file_name(name, "texture")
        file.write_bytes(data)
        self.files[file.as_posix()] = data
        return file.as_posix()

    def save(self, layer: Sdf.Layer, target: Path, base: str) -> None:
        """Save a layer over the file `base`, and its new textures beside it.

        :raises InputError: a folder that can't be written
        """
        with texture_home(target) as home, together(target):
            folder = TextureFolder(home)
            places = {path: folder.add(Path(path).name, data) for path, data in self.files.items()}
            if places:
                UsdUtils.ModifyAssetPaths(layer, lambda name: places.get(name, name))
            layer.subLayerPaths[0] = relative_path(base, target.parent)
            folder.write()
            save_layer(layer, target)


@contextlib.contextmanager
def texture_home(target: Path) -> Iterator[Path]:
    """The stage file that textures go beside: `target`, or for a .usdz one in a hidden folder that it is packed from.

    :raises InputError: the folder of `target` does not exist
    """
    if target.suffix.lower() != ".usdz":
        if not texture_folder(target).is_symlink():  # that would tidy up in somebody else's
            collect(texture_folder(target))
        yield target
        return
    if not target.parent.is_dir():
        raise InputError(target, "the folder does not exist")
    with hidden_folder(target.parent) as folder:
        yield folder / target.name


def texture_folder(stage_file: Path) -> Path:
    """Where the textures of a stage that is written go."""
    return stage_file.parent / f"{stage_file.stem}_textures"


def save_standalone(
    stage: Usd.Stage, path: str | os.PathLike[str], new: Mapping[str, bytes] = MappingProxyType({})
) -> None:
    """Flatten a stage and save it atomically; its textures are copied, so that the result can be moved.

    :param new: images by the paths that the stage has for them, as of `NewTextures`
    :raises InputError: a suffix that is not USD, a folder that can't be written, or a texture that may not be copied
    """
    target = Path(path)
    check_suffix(target)
    images = {**images_of(stage, new), **new}
    layer = flattened(stage)
    with texture_home(target) as home, together(target):
        folder = TextureFolder(home)
        copies = {resolved: folder.add(name_of(resolved), data) for resolved, data in images.items()}
        UsdUtils.ModifyAssetPaths(layer, lambda name: copies.get(name, name))
        folder.write()
        save_layer(layer, target, beside=home.parent)
