"""Our own plug-ins as what the registry's protocols ask for: mypy reads this and compares."""

from __future__ import annotations

import facepipe_gltf
import facepipe_onnx
from facepipe_gltf import read, vrm

from facepipe.registry import Exporter, Importer

EXPORTERS: tuple[Exporter, ...] = (facepipe_gltf, vrm, facepipe_onnx)
IMPORTERS: tuple[Importer, ...] = (read,)
