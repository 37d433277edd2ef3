"""The differentiable face: points to an image, with gradients."""

import facepipe.rig.torch  # noqa: F401  (which says what to install where torch is missing)
