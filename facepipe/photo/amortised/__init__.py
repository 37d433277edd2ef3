"""Where photo fits start: a network for one face's own controls, its training and its first guesses ([0180])."""

import facepipe.rig.torch  # noqa: F401  (which says what to install where torch is missing)
