"""A face from photos: sliders, expression, camera and light that show what the photos show."""

import facepipe.rig.torch  # noqa: F401  (which says what to install where torch is missing)
