"""Names of the release before: modules are found under them, with a warning that has the new one."""

from __future__ import annotations

import importlib
import sys
import warnings

import pytest

from facepipe.core.loading import MOVED


@pytest.mark.parametrize("old", MOVED)
def test_a_module_is_found_under_its_old_name(old: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=f"{old} is called {MOVED[old]} now"):
        found = importlib.import_module(old)
    assert found is importlib.import_module(MOVED[old])
    assert found.__spec__ is not None
    assert found.__spec__.name == MOVED[old]


def test_what_they_hold_is_the_same() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from facepipe.errors import InputError
        from facepipe.render.camera import Camera
    from facepipe.core import errors
    from facepipe.pictures import camera

    assert InputError is errors.InputError
    assert Camera is camera.Camera


def test_no_other_name_is_found() -> None:
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("facepipe.errors_of_others")
