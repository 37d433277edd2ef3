"""Training and descent of neural rigs, in torch."""

import facepipe.rig.torch  # noqa: F401  (which says what to install where torch is missing)
