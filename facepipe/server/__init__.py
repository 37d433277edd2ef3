"""Faces served: kept, worked on and streamed to browsers and devices, each person's apart."""
