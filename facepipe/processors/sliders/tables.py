"""Tables of sliders: TOML, and CSV in two forms."""

from __future__ import annotations

from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.processors.sliders import csv_table, toml_table
from facepipe.processors.sliders.slider_table import SliderTable


def read_table(path: Path) -> SliderTable:
    """The sliders of a .toml or .csv file; what they drive is checked against the face later.

    :raises InputError: another suffix, not readable, or damaged
    """
    readers = {".toml": toml_table.read, ".csv": csv_table.read}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(path, f"suffix '{path.suffix[:20]}', expected one of {', '.join(readers)}")
    return reader(path)
