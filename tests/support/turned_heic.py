"""Makes tests/photo/turned.heic, ramps that EXIF turns: `pip install pillow-heif==1.8.1`, then `turned_heic.py OUT`."""

from __future__ import annotations

import sys


def main() -> None:
    """Write 128 x 96 pixels, red to the right and green downward, with a quarter turn."""
    import pillow_heif
    from PIL import Image

    pillow_heif.register_heif_opener()
    image = Image.new("RGB", (128, 96))
    image.putdata([(2 * x, int(2.6 * y), 128) for y in range(96) for x in range(128)])
    exif = Image.Exif()
    exif[0x0112] = 6
    image.save(sys.argv[1], quality=90, exif=exif.tobytes())


if __name__ == "__main__":
    main()
