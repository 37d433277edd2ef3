"""Where photo fits start: a network for one face's own controls, its training and its first guesses ([0180])."""
