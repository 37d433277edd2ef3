"""The codeless USD schemas of facepipe. Importing this package registers them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_VARIABLE = "PXR_PLUGINPATH_NAME"


def path() -> Path:
    """The folder with plugInfo.json, for PXR_PLUGINPATH_NAME."""
    return Path(__file__).resolve().parent


def register() -> None:
    """Make the schemas known to USD; does nothing where they already are.

    Before anything has loaded USD, PXR_PLUGINPATH_NAME says where they are: USD reads it once, when it is loaded. USD
    builds its schema registry at first use: a host that opened a stage before this goes on without them.
    """
    if "pxr" not in sys.modules:
        known = os.environ.get(_VARIABLE, "").split(os.pathsep)
        if str(path()) not in known:
            os.environ[_VARIABLE] = os.pathsep.join([str(path()), *filter(None, known)])
        return
    from pxr import Plug

    registry = Plug.Registry()
    if registry.GetPluginWithName("facepipe") is None:
        registry.RegisterPlugins(str(path()))


register()
