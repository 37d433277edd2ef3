"""Recipes of the release before as those of now, which are read for one release: every field under its name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from facepipe.kinds import FOUND
from facepipe.parts import Recipe

_VERBS = {"neural-rig": "neural-rig apply"}  # then -> now
# verb -> the fields that its sources were, in their order
_SOURCES = {
    "animate": ("face", "clip"),
    "apply-bones": ("face", "coefficients"),
    "landmarks": ("face", "landmarks"),
    "neural-rig": ("face", "rig"),
    "regions": ("face", "map", "legend"),
}


def verb_now(verb: str) -> str:
    """What a verb of a recipe is called now."""
    return _VERBS.get(verb, verb)


def as_now(recipe: Recipe) -> Mapping[str, Any]:
    """The options of a recipe as actions of now keep them; what is damaged stays so."""
    options = recipe.options
    if not isinstance(options, Mapping):
        return options
    names = _SOURCES.get(recipe.verb, ())
    if names and names[0] not in options and len(recipe.sources) == len(names):
        return {**dict(zip(names, recipe.sources, strict=True)), **options}
    rewrite = _REWRITES.get(recipe.verb)
    return options if rewrite is None else rewrite(dict(options), recipe.sources)


def found_of(recipe: Recipe | None) -> Mapping[str, Any]:
    """What the action of a recipe found; nothing where there is no recipe, or it says nothing of that."""
    options = {} if recipe is None else as_now(recipe)
    found = options.get(FOUND) if isinstance(options, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def _skin(options: dict[str, Any], sources: tuple[str, ...]) -> Mapping[str, Any]:
    if "from" not in options or not isinstance(options.get("options"), Mapping) or len(sources) != 2:
        return options
    way = "joints" if options.pop("from") == "joints" else "source"
    return {"face": sources[0], way: sources[1], **options.pop("options"), **options}


def _blend(options: dict[str, Any], sources: tuple[str, ...]) -> Mapping[str, Any]:
    if set(options) != {"weights", "options"} or not isinstance(options["options"], Mapping):
        return options
    return {"sources": list(sources), "weights": options["weights"], **options["options"]}


_MEASURED = ("quality", "fit")


def _stage(options: dict[str, Any], sources: tuple[str, ...]) -> Mapping[str, Any]:
    """Stages of a rebuild: files and options under one name each, and what was found among what was given."""
    files, own = options.get("files", {}), options.get("options", {})
    if not isinstance(files, Mapping) or not isinstance(own, Mapping) or (FOUND in options and "files" not in options):
        return options
    found = {name: options[name] for name in _MEASURED if name in options}
    of_split = "weights" if "expressions" in files else FOUND
    found |= {"weights": options[of_split]} if of_split in options else {}
    kept = {name: value for name, value in options.items() if name not in ("files", "options", of_split, *_MEASURED)}
    return {**files, **own, **kept, **({FOUND: found} if found else {})}


def _fit_bones(options: dict[str, Any], sources: tuple[str, ...]) -> Mapping[str, Any]:
    if "rig" in options or not isinstance(options.get("options"), Mapping) or not sources:
        return options
    return {"rig": sources[0], **options.pop("options"), **options}


def _sliders(options: dict[str, Any], sources: tuple[str, ...]) -> Mapping[str, Any]:
    if "face" in options or not sources:
        return options
    own = options.pop("options", {})
    if len(sources) == 2:
        way = "network" if options.pop("network", False) else "table"
        return {"face": sources[0], way: sources[1], **options}
    return {"face": sources[0], **options, **(own if isinstance(own, Mapping) else {})}


def _fit_photo(options: dict[str, Any], sources: tuple[str, ...]) -> Mapping[str, Any]:
    files, own = options.get("files"), options.get("options")
    fit = own.get("fit") if isinstance(own, Mapping) else None
    if not (isinstance(files, Mapping) and isinstance(own, Mapping) and isinstance(fit, Mapping) and sources):
        return options
    kept = {name: value for name, value in own.items() if name != "fit"}
    kept |= {("landmark_weight" if name == "landmarks" else name): value for name, value in fit.items()}
    found = {"face": sources[0], "photos": options.get("photos"), **files, **kept}
    for name, each in (("landmarks", options.get("landmarks")), ("faces", own.get("faces"))):  # null: of no photo
        found[name] = [] if isinstance(each, list) and not any(one is not None for one in each) else each
    return found


_STAGES = ("fit-neutral", "refine-neutral", "personal-template", "register-scan", "split-shapes", "rebuild")
_REWRITES = {
    "blend": _blend,
    "fit-bones": _fit_bones,
    "fit-photo": _fit_photo,
    "skin": _skin,
    "sliders": _sliders,
    **dict.fromkeys(_STAGES, _stage),
}
