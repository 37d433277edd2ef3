"""Controls in files of neural rigs may be anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import neural_faces
import pytest

from facepipe.core.errors import InputError
from facepipe.neural import load_neural_rig, save_neural_rig
from facepipe.neural.neural_rig_file import KIND
from facepipe.verbs.array_file import read_arrays, write_arrays

WHOLE = {"name": "open", "minimum": 0.0, "maximum": 1.0, "default": 0.5}
FAULTS: dict[str, Any] = {
    "expected a list of controls": {"open": WHOLE},
    "no 'name', expected one": [{"minimum": 0.0}],
    "minimum: '../x', expected a finite number": [WHOLE | {"minimum": "../x"}],
    "name: 3, expected a text": [WHOLE | {"name": 3}],
    "default: None, expected a finite number": [WHOLE | {"default": None}],
    "from 1 to 1, expected a range": [WHOLE | {"minimum": 1.0, "default": 1.0}],
    "from 0 to 1, expected a range with its default, 2, in it": [WHOLE | {"default": 2}],
    "a name twice, expected each once": [WHOLE, WHOLE],
}


@pytest.mark.parametrize("words", FAULTS)
def test_controls_that_are_none_are_refused(tmp_path: Path, words: str) -> None:
    path = tmp_path / "rig.fpnr"
    save_neural_rig(neural_faces.neural_rig(neural_faces.face(), bones=False), path, {})
    arrays, content = read_arrays(path, KIND)
    write_arrays(path, KIND, content | {"controls": FAULTS[words]}, arrays)
    with pytest.raises(InputError) as caught:
        load_neural_rig(path)
    assert words in str(caught.value)
    assert str(caught.value).startswith(f"{path} -> controls")
