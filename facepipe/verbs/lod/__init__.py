"""Levels of detail: a face with fewer triangles that still does all that the face does."""
