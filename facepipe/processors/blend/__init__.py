"""Blend: K faces of one topology blended per region in the gradient domain, with shapes and rig."""
