"""`VRMC_vrm.meta`: the model's name, authors and permissions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.core.reading import read_json_object
from facepipe.records import Json
from facepipe_gltf.vrm.options import Options

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
_OTHERS = ("extensions", "extras", "thumbnailImage")
_FIELDS = (*_TEXTS, *_LISTS, *_FLAGS, *_CHOICES, *_OTHERS)
_LARGEST = 1 << 20  # bytes


def meta_of(options: Options, name: str, attribution: str) -> Json:
    """The meta of a model: of the options, of their file, and of the face's attribution.

    :param name: what the model is called where the file doesn't say
    :raises InputError: no licence, no authors, or a field that VRM doesn't have or takes otherwise
    """
    meta: Json = {"name": name}
    if attribution:
        meta |= {"authors": [attribution], "copyrightInformation": attribution}
    if options.meta is not None:
        meta |= _read(options.meta)
    authors = [one.strip() for one in options.authors.split(",") if one.strip()]
    if authors:
        meta["authors"] = authors
    if options.license_url:
        meta["licenseUrl"] = options.license_url
    if "authors" not in meta:
        raise InputError("option authors", "not given and the face has no attribution, expected a name")
    if "licenseUrl" not in meta:
        terms = f"expected {LICENSE_URL}, if you grant what it and --meta say, or licenseUrl in --meta"
        raise InputError("option license_url", f"not given, and no licence is ever assumed, {terms}")
    wrong = _expected("licenseUrl", meta["licenseUrl"])
    if wrong is not None:
        raise InputError("option license_url", f"{str(meta['licenseUrl'])[:60]}, expected {wrong}")
    return meta


def problems(meta: Json) -> list[tuple[str, str]]:
    """Errors of a meta object: field and message."""
    faults = [(one, "is missing, expected one") for one in ("name", "authors", "licenseUrl") if one not in meta]
    for field, value in meta.items():
        expected = _expected(field, value)
        if expected:
            faults.append((field, f"{json.dumps(value)[:60]}, expected {expected}"))
    return faults


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


def _read(path: Path) -> Json:
    meta: Json = read_json_object(path, _LARGEST)
    if "thumbnailImage" in meta:
        raise InputError(
            path, "thumbnailImage is the number of an image in a file, expected none: this makes no thumbnail"
        )
    for field, value in meta.items():
        expected = _expected(field, value)
        if expected is not None:
            raise InputError(f"{path} -> {field}", f"{json.dumps(value)[:60]}, expected {expected}")
    return meta
