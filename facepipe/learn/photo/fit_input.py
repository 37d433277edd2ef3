"""What a photo fit can be given."""

from __future__ import annotations

from collections.abc import Mapping

from facepipe.errors import InputError
from facepipe.learn.features.description import Kind
from facepipe.learn.features.extractor import Extractor
from facepipe.learn.photo.joint_loss import FEATURES


def check_extractors(extractors: Mapping[Kind, Extractor]) -> None:
    """:raises InputError: a network for no term of the joint loss, or one that doesn't give what it is there for"""
    for kind, one in extractors.items():
        where = f"extractors -> {kind}"
        if kind not in FEATURES:
            raise InputError(where, f"no term of the joint loss, expected one of {', '.join(FEATURES)}")
        if not isinstance(one, Extractor) or kind not in one.kinds:
            gives = f"a network of {', '.join(one.kinds)}" if isinstance(one, Extractor) else f"a {type(one).__name__}"
            raise InputError(where, f"{gives}, expected a network of {kind} (`load_extractor`)")
