"""An OBJ of two objects with materials."""

from __future__ import annotations

NEUTRAL = """# two loose objects
mtllib face.mtl
o Face
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 2 0 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl skin
f 1/1/1 2/2/1 3/3/1 4/4/1
f 2/1/1 5/2/1 3/3/1
o Left eye
v 5 0 0
v 6 0 0
v 6 1 0
usemtl eye
f -3/1/1 -2/2/1 -1/3/1
"""


MTL = "newmtl skin\nKd 0.5 0.25 0.125\nd 0.5\nnewmtl eye\nKd 1 1 1\nmap_Kd -s 2 2 2 maps/eye 1.png\n"


PNG = b"\x89PNG not really"
