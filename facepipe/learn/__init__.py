"""Everything that needs torch: the differentiable face, from sliders to an image (``pip install facepipe[train]``).

Tensors in, tensors out, batched where a leading dimension is named; no stages and no files. Importing this package
imports torch, so the rest of facepipe does so only inside the functions that need it.
"""

from __future__ import annotations

from importlib.util import find_spec

from facepipe.core.errors import InputError

if find_spec("torch") is None:
    raise InputError("facepipe.learn", "torch is not installed, expected: pip install 'facepipe[train]'")
