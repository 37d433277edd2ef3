"""The network of features that comes with facepipe, as extractors."""

from __future__ import annotations

from collections.abc import Sequence

from facepipe.core.errors import InputError
from facepipe.networks import feature_model
from facepipe.networks.description import Kind
from facepipe.photo.features.extractor import Extractor, load_extractor


def own_extractors(kinds: Sequence[Kind]) -> dict[Kind, Extractor]:
    """The extractor of each kind: one network for all, so that one forward serves them.

    :raises InputError: a kind that it does not have
    """
    loaded = load_extractor(feature_model(), kinds[0], bounded=True) if kinds else None
    missing = [kind for kind in kinds if loaded is None or kind not in loaded.kinds]
    if missing:
        raise InputError(feature_model(), f"has no {missing[0]}, expected one of {loaded.kinds if loaded else ()}")
    return {kind: loaded for kind in kinds if loaded is not None}
