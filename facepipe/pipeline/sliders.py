"""Sliders: authored, made or set by `facepipe sliders`, and again from its recipes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from facepipe.core.errors import InputError, SchemaError
from facepipe.core.reports import Report
from facepipe.kinds import Watch
from facepipe.pipeline.verbs import Cooked, under_source
from facepipe.processors.sliders import (
    AuthorNetwork,
    AuthorSliders,
    SetSliders,
    SetSlidersReport,
    ShapeSlidersReport,
    SliderRecipe,
    SlidersFromShapes,
    read_slider_recipe,
    read_table,
    slider_recipe,
)
from facepipe.stage import Face, open_face

Made = TypeVar("Made", bound=Report)


def cook(path: Path, watch: Watch) -> Cooked:
    """Author, make or set sliders again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read or used
    """
    old = read_slider_recipe(path)
    if old.shapes is not None:
        made = make(old.face, path, old.shapes, watch, flatten=old.standalone)
        return Cooked(report=made, missed=bool(made.left_out))
    if old.settings is not None:
        posed = derive(old.face, path, _setting(old.face, path, old.settings), flatten=old.standalone)
        return Cooked(report=posed, missed=bool(posed.beyond_limits))
    author = _table(old, path, old.table) if old.table is not None else _network(old, path)
    return Cooked(report=derive(old.face, path, author, flatten=old.standalone))


def _setting(face: Path, out: Path, settings: SetSliders) -> Callable[[Face], SetSlidersReport]:
    recipe = slider_recipe(face, out, settings=settings)
    return lambda derived: settings(derived, recipe=recipe)


def _table(old: SliderRecipe, out: Path, table: Path) -> Callable[[Face], Report]:
    author = AuthorSliders(table=read_table(table), drop=old.drop)
    recipe = slider_recipe(old.face, out, table=table, drop=old.drop)
    return lambda derived: author(derived, recipe=recipe)


def _network(old: SliderRecipe, out: Path) -> Callable[[Face], Report]:
    if old.network is None:
        raise SchemaError(f"{out} -> recipe", "nothing to do, expected a table, a network, settings or shapes")
    author = network_author(open_face(old.face), old.network)
    recipe = slider_recipe(old.face, out, network=old.network)
    return lambda derived: author(derived, recipe=recipe)


def derive(face: Path, out: Path, author: Callable[[Face], Made], *, flatten: bool = False) -> Made:
    """What `author` does over the face at a path, saved as `out`.

    :raises FacepipeError: of `author`, or a face that can't be read, or `out` not written
    """
    with open_face(face).deriving(out, flatten=flatten) as derived, under_source(face):
        return author(derived)


def make(face: Path, out: Path, maker: SlidersFromShapes, watch: Watch, *, flatten: bool = False) -> ShapeSlidersReport:
    """Sliders of the blendshapes of the face at a path, saved as `out`.

    :raises InputError: bones that reach no shape
    :raises FacepipeError: what can't be fitted, read or written
    """
    recipe = slider_recipe(face, out, shapes=maker)

    def author(derived: Face) -> ShapeSlidersReport:
        with watch("fit", len(maker.chosen(derived))) as bar:
            report = maker(derived, recipe=recipe, done=bar.update)
        if not report.sliders:
            what = "bones reach no shape, expected some that they can (or --residual, or a lower --least-reach)"
            raise InputError(derived.where, what)
        return report

    return derive(face, out, author, flatten=flatten)


def network_author(face: Face, file: Path) -> AuthorNetwork:
    """The processor that authors the learned network of a file.

    :raises InputError: another suffix, or as `read_network` does
    """
    from facepipe.importers.slider_network import read_network

    if file.suffix.lower() != ".npz":
        raise InputError(file, f"suffix '{file.suffix[:20]}', expected .npz")
    return AuthorNetwork(network=read_network(file, face.skeleton.joints, face.shapes))
