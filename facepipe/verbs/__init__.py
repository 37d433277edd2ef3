"""Processors: each a frozen dataclass of options, called on a face."""
