"""Options of the VRM exporter, and `VRMC_vrm.meta` that they make: the model's name, authors and permissions."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.core.reading import read_json_object
from facepipe.declare import option
from facepipe_gltf.options import Options as GltfOptions

if TYPE_CHECKING:
    from facepipe.records import Json  # which loads numpy

EXTENSION = "VRMC_vrm"
LICENSE_URL = "https://vrm.dev/licenses/1.0/"  # the only one that VRM 1.0 has (meta.md) and its runtimes load
_TEXTS = (
    *("name", "version", "copyrightInformation", "contactInformation", "thirdPartyLicenses", "licenseUrl"),
    "otherLicenseUrl",
)
_LISTS = ("authors", "references")
_FLAGS = (
    *("allowExcessivelyViolentUsage", "allowExcessivelySexualUsage", "allowPoliticalOrReligiousUsage"),
    *("allowAntisocialOrHateUsage", "allowRedistribution"),
)
_CHOICES = {
    "avatarPermission": ("onlyAuthor", "onlySeparatelyLicensedPerson", "everyone"),
    "commercialUsage": ("personalNonProfit", "personalProfit", "corporation"),
    "creditNotation": ("required", "unnecessary"),
    "modification": ("prohibited", "allowModification", "allowModificationRedistribution"),
}
STRICTEST = {  # what holds where a file doesn't say (meta.md)
    "avatarPermission": "onlyAuthor",
    "allowExcessivelyViolentUsage": False,
    "allowExcessivelySexualUsage": False,
    "commercialUsage": "personalNonProfit",
    "allowPoliticalOrReligiousUsage": False,
    "allowAntisocialOrHateUsage": False,
    "creditNotation": "required",
    "allowRedistribution": False,
    "modification": "prohibited",
}
_OWN = ("name", "version")  # no terms: who changes a model may call it otherwise
_OTHERS = ("extensions", "extras", "thumbnailImage")
_FIELDS = (*_TEXTS, *_LISTS, *_FLAGS, *_CHOICES, *_OTHERS)
_LARGEST = 1 << 20  # bytes


@dataclass(frozen=True, kw_only=True)
class Options:
    """What goes into the file, and under which terms."""

    license_url: str = option(
        "", "the model's licence, which facepipe never chooses; VRM 1.0 has https://vrm.dev/licenses/1.0/"
    )
    authors: str = option("", "the model's authors, separated by commas; the face's attribution where not given")
    meta: Path | None = option(None, "JSON object of VRM's further meta fields: version, commercialUsage ...")
    stub_body: bool = option(False, "add the required human bones that the face lacks, as nodes that move no point")
    bones: str = option("", "human bones whose joints have names of their own: BONE=JOINT, separated by commas")
    pose: str = option(
        "set",
        "the person that becomes the rest: set (slider values, applied bone coefficients), rest (the "
        "template), or an animation of the face",
    )
    shapes: str = option("*", "blendshapes to export: globs, separated by commas")
    morph_normals: bool = option(True, "compute the normals of blendshapes that have none; runtimes compute none")

    @property
    def gltf(self) -> GltfOptions:
        """Those of the glTF writer: what every VRM runtime reads."""
        return GltfOptions(shapes=self.shapes, morph_normals=self.morph_normals)


def meta_of(options: Options, name: str, attribution: str, kept: Json | None = None) -> Json:
    """The meta of a model: of the options, of their file, and of the face's attribution.

    :param name: what the model is called where the file doesn't say
    :param kept: the terms that a face of a VRM came with: options add to them, and change none
    :raises InputError: no licence, no authors, a field that VRM doesn't have or takes otherwise, or another term than
        the face came with
    """
    meta: Json = {"name": name}
    if attribution and "authors" not in (kept or {}):
        meta |= {"authors": [attribution], "copyrightInformation": attribution}
    meta |= kept or {}
    given = _given(options)
    # a field that is not there has a value too, the strictest: another would be looser
    standing = {} if kept is None else STRICTEST | kept
    for field, value in given.items():
        if field not in _OWN and field in standing and standing[field] != value:
            where = f"option {field if options.meta is None or field == 'authors' else 'meta'}"
            terms = f"{field} is {json.dumps(standing[field], ensure_ascii=False)[:80]}"
            raise InputError(where, f"{json.dumps(value)[:60]}, but the terms that the face came with say: {terms}")
    meta |= given
    if "authors" not in meta:
        raise InputError("option authors", "not given and the face has no attribution, expected a name")
    if "licenseUrl" not in meta:
        terms = f"expected {LICENSE_URL}, if you grant what it and --meta say, or licenseUrl in --meta"
        raise InputError("option license_url", f"not given, and no licence is ever assumed, {terms}")
    wrong = _expected("licenseUrl", meta["licenseUrl"])
    if wrong is not None:
        raise InputError("option license_url", f"{str(meta['licenseUrl'])[:60]}, expected {wrong}")
    return meta


def _given(options: Options) -> Json:
    """The fields of meta that the options and their file say."""
    meta: Json = {}
    if options.meta is not None:
        given: Json = read_json_object(options.meta, _LARGEST)
        if "thumbnailImage" in given:
            problem = "thumbnailImage is the number of an image in a file, expected none: this makes no thumbnail"
            raise InputError(options.meta, problem)
        for field, what in _faults(given):
            raise InputError(f"{options.meta} -> {field}", what)
        meta |= given
    # flags take precedence over the file, and the file over the face: who exports knows best
    authors = [one.strip() for one in options.authors.split(",") if one.strip()]
    if authors:
        meta["authors"] = authors
    if options.license_url:
        meta["licenseUrl"] = options.license_url
    return meta


def problems(meta: Json) -> list[tuple[str, str]]:
    """Errors of a meta object: field and message."""
    lacking = [(one, "is missing, expected one") for one in ("name", "authors", "licenseUrl") if one not in meta]
    return lacking + _faults(meta)


def _faults(meta: Json) -> list[tuple[str, str]]:
    """Fields with values that VRM doesn't take, and a message on each."""
    found = [(field, fault(field, value)) for field, value in meta.items()]
    return [(field, what) for field, what in found if what is not None]


def fault(field: str, value: Any) -> str | None:
    """A message on a field of meta that VRM doesn't have or takes otherwise; None where it is right."""
    what = _expected(field, value)
    if what is None:
        return None
    try:
        return f"{json.dumps(value)[:60]}, expected {what}"
    except RecursionError:  # a reader nests as deep as Python lets it, and a writer less deep
        return f"JSON nested too deeply, expected {what}"


def _expected(field: str, value: Any) -> str | None:
    """What is expected instead of the value; None where the value is right."""
    if field in _CHOICES:
        return None if value in _CHOICES[field] else " or ".join(_CHOICES[field])
    if field in _FLAGS:
        return None if isinstance(value, bool) else "true or false"
    if field in _LISTS:
        texts = isinstance(value, list) and all(isinstance(one, str) and one.strip() for one in value)
        return None if texts and value else "a list of texts"
    if field == "licenseUrl":
        return None if value == LICENSE_URL else f"{LICENSE_URL} (others go to otherLicenseUrl)"
    if field in _TEXTS:
        return None if isinstance(value, str) and (value.strip() or field != "name") else "a text"
    return None if field in _OTHERS else f"a field of VRM's meta{did_you_mean(field, _FIELDS)}"
