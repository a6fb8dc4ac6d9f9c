"""Images that are read, with their limits. Not in `files`: planning alone goes without OpenCV and Pillow."""

import io
import warnings
from typing import Any

import cv2
import numpy as np
from jaxtyping import Shaped
from PIL import Image, UnidentifiedImageError

from potlp_jax.files import MIB

MOST_IMAGE: int = 256 * MIB
"""Bytes of an image file."""

MOST_PIXELS: int = 1 << 25
"""Pixels of an image: 5,792 squared, nearly 300 m of building at 0.05 m a pixel. Reading takes some 40 bytes each."""

# What map savers and cameras write. Formats that run programs or fetch other files (EPS) are not among them.
_IMAGE_FORMATS = ("PNG", "BMP", "JPEG", "TIFF", "WEBP", "PPM")

# Markers of a JPEG, before its pixels and after them: a thumbnail in front has its own. Pixels never hold one.
_JPEG_SCAN, _JPEG_END = b"\xff\xda", b"\xff\xd9"

# OpenCV 4 has its switch at the top, OpenCV 5 in a module of its own.
_OPENCV_LOG: Any = getattr(cv2.utils, "logging", cv2)
_SILENT = 0


def decode_image(contents: bytes, flags: int, whole: bool = False) -> Shaped[np.ndarray, "H W *C"]:
    """Pixels of an encoded image, as OpenCV orders its channels.

    Args:
        contents: a file of one of the usual formats.
        flags: of ``cv2.imdecode``.
        whole: refuse what is cut short in any format, at the price of decoding twice.

    Returns:
        The pixels.

    Raises:
        ValueError: it has more than `MOST_PIXELS`, as its header says before anything is decoded; or it is damaged. PNG
            has checksums: none of its damage goes unnoticed. So do other errors of Pillow.
    """
    # OpenCV passes over the checksums of PNG, and shows grey for what is missing of a JPEG; Pillow does neither.
    with _header(contents) as image:
        width, height = image.size
        if image.format == "PNG":
            image.verify()
        elif whole:
            image.load()
    pixels = _decoded(contents, flags)
    # Either of the two libraries may reject what the other reads.
    if pixels is None or pixels.shape[:2] not in ((height, width), (width, height)):
        raise ValueError("its pixels cannot be decoded")
    return pixels


def _decoded(contents: bytes, flags: int) -> np.ndarray | None:
    # OpenCV writes its own lines about damage to the error stream, beside the one that the reader's error is.
    level = _OPENCV_LOG.getLogLevel()
    _OPENCV_LOG.setLogLevel(_SILENT)
    try:
        return cv2.imdecode(np.frombuffer(contents, np.uint8), flags)
    finally:
        _OPENCV_LOG.setLogLevel(level)


def image_size(contents: bytes) -> tuple[int, int]:
    """Width and height of an encoded image, by its header. Raises ValueError, and whatever Pillow raises."""
    with _header(contents) as image:
        return image.size


def check_whole(contents: bytes) -> None:
    """Refuse an encoded image that is cut short.

    Cheap enough for every picture of a recording: PNG and JPEG are not decoded.

    Args:
        contents: a file of one of the usual formats.

    Raises:
        ValueError: it is no image, is too large, or is a JPEG without an end. So do other errors of Pillow, where
            another format is cut short, or a checksum of a PNG is wrong.
    """
    with _header(contents) as image:
        if image.format == "PNG":
            image.verify()
        # Two pictures in one file are another format to Pillow.
        elif image.format in ("JPEG", "MPO"):
            # Not at the very end: cameras put padding behind it.
            if contents.rfind(_JPEG_END) < contents.rfind(_JPEG_SCAN):
                raise ValueError("its pixels have no end")
        else:
            image.load()


def _header(contents: bytes) -> Image.Image:
    """An image of which only the header is read. Raises ValueError."""
    with warnings.catch_warnings():
        # Pillow has a limit on pixels of its own, far above this one, and speaks of attacks.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            image = Image.open(io.BytesIO(contents), formats=_IMAGE_FORMATS)
        except UnidentifiedImageError as error:
            raise ValueError("it does not begin as any image does") from error
        except Image.DecompressionBombError as error:
            raise ValueError(f"it has more than the {MOST_PIXELS:,} pixels that are read at most") from error
    width, height = image.size
    if width * height > MOST_PIXELS:
        raise ValueError(f"it has {width:,} x {height:,} pixels; at most {MOST_PIXELS:,} are read")
    return image
