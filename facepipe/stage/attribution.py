"""The attribution of a file, without the face in it being read."""

from __future__ import annotations

from pathlib import Path

from pxr import Sdf

from facepipe.core import tokens
from facepipe.stage.files import SUFFIXES, quiet_diagnostics
from facepipe.stage.guard import USD_ERRORS


def attribution_of(path: Path) -> str:
    """The copyright and license line on the default prim of a layer; empty where it holds none, as over another."""
    if path.suffix.lower() not in SUFFIXES:
        return ""
    with quiet_diagnostics():
        try:
            layer = Sdf.Layer.FindOrOpen(str(path))
            spec = layer.GetAttributeAtPath(f"/{layer.defaultPrim}.{tokens.ATTRIBUTION}") if layer else None
        except (*USD_ERRORS, RuntimeError):
            return ""
    return str(spec.default or "") if spec else ""
