"""The rig in torch, with gradients: sliders, deformation, distilled sliders, descent (``pip install facepipe[train]``).

Tensors in, tensors out, batched where a leading dimension is named; no stages and no files. Importing this package
imports torch, so the rest of facepipe does so only inside the functions that need it.
"""

from importlib.util import find_spec

from facepipe.core.errors import InputError

if find_spec("torch") is None:
    raise InputError("facepipe.rig.torch", "torch is not installed, expected: pip install 'facepipe[train]'")

import torch as torch  # other rooms take it from here, which says what to install
