"""Controls of neural rigs out of JSON."""

from __future__ import annotations

from dataclasses import replace

from facepipe.core.errors import InputError
from facepipe.declare import from_json
from facepipe.rig.neural_rig import Control


def controls_from(content: object, where: str) -> tuple[Control, ...]:
    """The controls of a list of objects.

    :raises InputError: no such list, a name twice, or a range that is empty or does not hold its default
    """
    if not isinstance(content, list):
        raise InputError(where, f"{str(content)[:40]}, expected a list of controls")
    given = [from_json(Control, one, f"{where} -> {number}") for number, one in enumerate(content)]
    found = tuple(  # numpy makes objects of whole numbers beyond 64 bits
        replace(one, minimum=float(one.minimum), maximum=float(one.maximum), default=float(one.default))
        for one in given
    )
    for one in found:
        if not one.minimum <= one.default <= one.maximum or one.minimum == one.maximum:
            what = f"from {one.minimum:g} to {one.maximum:g}, expected a range with its default, {one.default:g}, in it"
            raise InputError(f"{where} -> {one.name[:80]}", what)
    if len({one.name for one in found}) != len(found):
        raise InputError(where, "a name twice, expected each once")
    return found
