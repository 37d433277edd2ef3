"""Skin as pictures show it, evened and freed of light: what textures from photos and from scans share."""
