"""Rooms of the GDC maps from the labels that come with them: polygons in image pixels, y down."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from potlp_jax.environments.ros.occupancy_map import load_map

HALLWAYS = {
    "gdc_3ne": {"l3_200", "l3_250", "l3_300", "l3_400", "l3_434", "l3_500", "l3_520"},
    "gdc_floor2": {f"l2_{number}00" for number in range(1, 9)},
}
"""Labelled areas that are hallways, or the hall of the second floor, and so no rooms."""

LABELS = {"gdc_3ne": "gdc_3ne_locations.yaml", "gdc_floor2": "gdc_2_locations.yaml"}


def rooms_from_labels(maps: Path, name: str) -> dict[str, Any]:
    """What a rooms file holds (``environments.ros.mapped_rooms``), in map metres."""
    frame = load_map(maps / f"{name}.yaml").frame
    labels = yaml.safe_load((maps / "labels" / LABELS[name]).read_text())
    rooms = {}
    for room, polygon in zip(labels["locations"], labels["polygons"], strict=True):
        if room not in HALLWAYS[name]:
            column, row = np.reshape(polygon, (-1, 2)).T
            x, y = frame.x + column * frame.resolution, frame.y + (frame.height - row) * frame.resolution
            # Labels repeat the first vertex at the end.
            rooms[room] = [{"polygon": np.round(np.stack([x, y], axis=1)[:-1], 3).tolist()}]
    return {"rooms": rooms}
