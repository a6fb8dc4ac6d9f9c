"""Pictures of real cameras, mapped to the geometry of ``camera``, and back.

Both geometries have columns even in bearing; they differ in where their rows look. A real picture's rows are even in
elevation, this camera's crowd around the horizon, where far floors are.
"""

import math

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from potlp_jax.world.camera import CameraConfig, column_bearings, finer, row_slopes, rows_at_slopes

_MOST_SAMPLES = 8
"""Samples a side of a pixel at most; at 512 columns they resolve a real picture of 4,096."""


def from_equirectangular(
    image: UInt8[np.ndarray, "h w 3"],
    config: CameraConfig,
    yaw: float = 0.0,
    vertical_field: float = math.pi,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The picture that the camera of ``config`` would have taken.

    Args:
        image: an equirectangular picture of any size: columns even in bearing over the full circle, growing to the
            right, rows even in elevation, the horizon between the two middle rows. The channels keep their order.
        config: the geometry to map to.
        yaw: bearing in the map's frame, in radians, along which the middle of ``image`` looks: the robot's heading.
        vertical_field: angle in radians from the image's lower to its upper edge. Beyond it the outermost row
            is repeated.

    Returns:
        The panorama, in the frame of the map.

    Raises:
        ValueError: where the image is no colour picture or the field is not between 0 and pi.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0 or image.dtype != np.uint8:
        raise ValueError(f"the image must be uint8[h, w, 3], found {image.dtype}{list(image.shape)}")
    if not 0 < vertical_field <= math.pi:
        raise ValueError(f"vertical_field must lie between 0 and pi radians, found {vertical_field}")
    height, width = image.shape[:2]
    # Several samples a pixel, averaged at the end: near the robot's feet one row covers many of the image's.
    samples = _samples(config, height / vertical_field, width)
    fine = finer(config, samples)
    # Coordinates count from the middle of the first pixel, as OpenCV's do, hence the halves.
    rows = height * (0.5 - np.arctan(row_slopes(fine)) / vertical_field) - 0.5
    columns = (column_bearings(fine) - yaw + math.pi) / (2 * math.pi) * width - 0.5
    # One column of the other side at each edge closes the circle.
    closed = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
    sampled = cv2.remap(
        closed,
        _grid((columns + 0.5) % width + 0.5, (fine.height, 1)),
        _grid(rows[:, None], (1, fine.width)),
        interpolation=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return cv2.resize(sampled, (config.width, config.height), interpolation=cv2.INTER_AREA)


def to_equirectangular(
    panorama: UInt8[np.ndarray, "rows columns 3"], config: CameraConfig, height: int, width: int, yaw: float = 0.0
) -> UInt8[np.ndarray, "h w 3"]:
    """The full sphere that a panoramic camera would have delivered: the inverse of ``from_equirectangular``.

    Beyond the panorama's upper and lower edge its outermost row is repeated.

    Args:
        panorama: a picture of the camera of ``config``.
        config: its geometry.
        height, width: rows and columns of the result.
        yaw: bearing in the map's frame, in radians, along which the middle of the result looks.

    Returns:
        The equirectangular picture, over all elevations.
    """
    # Bearings and elevations of the result's pixels, then where the panorama has them.
    elevations = math.pi * (0.5 - (np.arange(height) + 0.5) / height)
    bearings = yaw + 2 * math.pi * (np.arange(width) + 0.5) / width - math.pi
    columns = (bearings + math.pi) / (2 * math.pi) * config.width - 0.5
    rows = np.clip(rows_at_slopes(config, np.tan(elevations)), 0, config.height - 1)
    # One column of the other side at each edge closes the circle.
    closed = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    return cv2.remap(
        closed,
        _grid((columns + 0.5) % config.width + 0.5, (height, 1)),
        _grid(rows[:, None], (1, width)),
        interpolation=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )


def _samples(config: CameraConfig, rows_per_radian: float, width: int) -> int:
    """Samples a side of each pixel: as many as the image has pixels there, at most ``_MOST_SAMPLES``."""
    elevations = np.arctan(row_slopes(config))
    # The most that any row covers: the number of samples is one for the whole picture.
    tallest = rows_per_radian * np.max(-np.diff(elevations)) if config.height > 1 else 1.0
    return min(_MOST_SAMPLES, math.ceil(max(tallest, width / config.width)))


def _grid(values: np.ndarray, tiles: tuple[int, int]) -> Float32[np.ndarray, "rows columns"]:
    """A row or a column of coordinates, repeated to the size of the picture."""
    # OpenCV takes contiguous float32 alone.
    return np.ascontiguousarray(np.tile(values, tiles), np.float32)
