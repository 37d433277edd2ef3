"""Feature extractors: networks that measure how alike two pictures of a face are, with gradients to the pixels."""

import facepipe.rig.torch  # noqa: F401  (which says what to install where torch is missing)
