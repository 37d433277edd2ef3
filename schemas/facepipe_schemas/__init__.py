"""The codeless USD schemas of facepipe. Importing this package registers them."""

from __future__ import annotations

from pathlib import Path


def path() -> Path:
    """The folder with plugInfo.json, for PXR_PLUGINPATH_NAME."""
    return Path(__file__).resolve().parent


def register() -> None:
    """Make the schemas known to USD; does nothing where they already are.

    USD builds its schema registry at first use: a host that opened a stage before this needs PXR_PLUGINPATH_NAME.
    """
    from pxr import Plug

    registry = Plug.Registry()
    if registry.GetPluginWithName("facepipe") is None:
        registry.RegisterPlugins(str(path()))


register()
