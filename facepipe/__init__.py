"""facepipe: face assets from a DCC to a game engine."""

__version__ = "0.1.0"
