"""Loaded by workers of a cluster (``--preload``): their processes do the made-up lines of `farm_child`."""

from __future__ import annotations

import farm_child

from facepipe.tasks import child

child.PROGRAM = farm_child.__name__
