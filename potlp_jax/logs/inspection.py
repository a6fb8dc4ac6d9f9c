"""What is in a log, and what it can be used for."""

from typing import Any

import numpy as np

from potlp_jax.errors import LogError
from potlp_jax.logs.log import (
    IMAGE_TYPE,
    MAP_TYPE,
    MAP_UPDATE_TYPE,
    ODOMETRY_TYPE,
    RAW_IMAGE_TYPE,
    SECOND,
    TRANSFORM_TYPES,
    Log,
)
from potlp_jax.logs.pictures import vertical_field

GAP_FACTOR, GAP_SECONDS = 5.0, 2.0
"""A pause is a gap if it is so many times the topic's usual interval, and so long."""

_NOT_READ = {
    RAW_IMAGE_TYPE: "not read: record its compressed topic",
    MAP_UPDATE_TYPE: "not read: have whole maps published",
}


def inspect(log: Log) -> dict[str, Any]:
    """A description of a log, JSON-able: topics, span, map, pose, pictures, uses and problems."""
    # All topics, also those that nothing here reads: the span is the recording's.
    times = [time for received in log.bag.times.values() for time in received]
    pose = _pose_problem(log)
    picture = _picture_problem(log)
    missing_map = None if log.last_map is not None else f"no map: record a topic of type {MAP_TYPE}"
    # What is missing is named in full, so that the report alone tells what to record.
    replay = "; ".join(filter(None, (missing_map, pose)))
    with_panoramas = "; ".join(filter(None, (missing_map, pose, picture)))
    return {
        "bag": str(log.path),
        "format": log.bag.format,
        "start": min(times) / SECOND,
        "seconds": (max(times) - min(times)) / SECOND,
        "messages": len(times),
        "topics": [_topic(log, name) for name in sorted(log.bag.topics)],
        "map": _map(log),
        "pose": {"map_frame": log.map_frame, "base_frame": log.base_frame, "frames": sorted(log.transforms.frames)},
        "pictures": _pictures(log),
        "uses": {
            "replay without pictures (baseline, optimistic, oracle)": replay or "yes",
            "replay of potlp": with_panoramas or "yes, with an estimator (--estimator)",
            "to-dataset": with_panoramas or "yes",
        },
        "problems": list(log.problems),
    }


def _topic(log: Log, name: str) -> dict[str, Any]:
    # Sorted: damaged bags are not in order.
    kind, received = log.bag.topics[name], np.sort(np.array(log.bag.times[name], np.int64))
    span = float(received[-1] - received[0]) / SECOND
    intervals = np.diff(received) / SECOND
    # The median, which a few long pauses do not move.
    usual = float(np.median(intervals)) if len(intervals) else 0.0
    gaps = [
        {"after": float(received[index] - received[0]) / SECOND, "seconds": float(intervals[index])}
        # Both conditions: a slow topic has long intervals, a fast one has jitter.
        for index in np.flatnonzero((intervals > GAP_SECONDS) & (intervals > GAP_FACTOR * usual))
    ]
    return {
        "name": name,
        "type": kind,
        "count": len(received),
        "rate": (len(received) - 1) / span if span > 0 else None,
        "gaps": gaps,
        "use": _use(log, name, kind),
    }


def _use(log: Log, name: str, kind: str) -> str:
    # Each topic says what it is good for, so that nobody wonders why one is ignored.
    chosen = {log.map_topic: "map", log.image_topic: "panorama"}
    if name in chosen:
        return chosen[name]
    if kind in (MAP_TYPE, IMAGE_TYPE):
        return "another is used"
    if kind in (ODOMETRY_TYPE, *TRANSFORM_TYPES):
        return "pose"
    return _NOT_READ.get(kind, "")


def _map(log: Log) -> dict[str, Any] | None:
    last = log.last_map
    if last is None:
        return None
    # By the thresholds in use: a map that is all unknown shows at once.
    free, obstacles = last.free(log.config).mean(), last.obstacles(log.config).mean()
    return {
        "count": log.map_count,
        "frame": last.frame_id,
        "cells": [last.frame.height, last.frame.width],
        "resolution": last.frame.resolution,
        "origin": [last.frame.x, last.frame.y, last.frame.yaw],
        "free": float(free),
        "obstacles": float(obstacles),
        "unknown": float(1 - free - obstacles),
    }


def _pictures(log: Log) -> dict[str, Any] | None:
    if not log.pictures:
        return None
    sizes = sorted({(picture.width, picture.height) for picture in log.pictures})
    return {"count": len(log.pictures), "sizes": [list(size) for size in sizes], "frame": log.pictures[0].frame_id}


def _pose_problem(log: Log) -> str | None:
    base, frame = log.base_frame, log.map_frame
    if base is None:
        return "no pose: record /tf, or name the robot's frame with --base-frame"
    if frame is not None and log.transforms.chain(frame, base) is None:
        return f"nothing says where {base!r} lies in {frame!r}: record /tf"
    return None


def _picture_problem(log: Log) -> str | None:
    if not log.pictures and log.image_topic is not None:
        return f"no picture can be read from {log.image_topic}"
    if not log.pictures:
        return f"no picture: record a topic of type {IMAGE_TYPE}"
    try:
        vertical_field(log.pictures[0].width, log.pictures[0].height, log)
    except LogError as error:
        return str(error)
    return None
