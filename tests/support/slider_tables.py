"""The same sliders in each form of table."""

from __future__ import annotations

TOML = """
[slider.width]
group = "nose"
range = [-1, 1]
channels = { "jaw:tx" = 0.5, "root:sy" = -0.25 }
[slider.openLeft]
default = 0.25
mirror = "openRight"
channels = { "lidLeft:rx" = 0.5 }
shapes = { smileLeft = 2 }
[slider.openRight]
default = 0.25
channels = { "lidRight:rx" = 0.5 }
shapes = { smileRight = 2 }
"""


LIST = """slider,target,gain,group,min,max,default,mirror
width,jaw:tx,0.5,nose,-1,1,,
width,root:sy,-0.25,,,,,
openLeft,lidLeft:rx,0.5,,,,0.25,openRight
openRight,lidRight:rx,0.5,,,,0.25,
openLeft,smileLeft,2,,0,1,,
openRight,smileRight,2,,,,,
"""


MATRIX = """slider,jaw:tx,root:sy,lidLeft:rx,lidRight:rx,smileLeft,smileRight,group,min,max,default,mirror
width,0.5,-0.25,0,0,,,nose,-1,1,,
openLeft,0,0,0.5,0,2,0,,,,0.25,openRight
openRight,0,0,0,0.5,0,2,,0,1,0.25,
"""
