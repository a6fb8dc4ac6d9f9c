"""What an estimator's file says of how it was made. Metadata are anybody's JSON: what has another form says nothing."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from potlp_jax.checks import COUNT


def mapping_in(metadata: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """An entry that is a mapping; an empty one where there is none."""
    found = metadata.get(name)
    return found if isinstance(found, Mapping) else {}


def number_in(metadata: Mapping[str, Any], name: str) -> int | float | None:
    """An entry that is a finite number; None where there is none."""
    found = metadata.get(name)
    return found if isinstance(found, int | float) and not isinstance(found, bool) and math.isfinite(found) else None


def text_in(metadata: Mapping[str, Any], name: str) -> str:
    """An entry that is a text; an empty one where there is none."""
    found = metadata.get(name)
    return found if isinstance(found, str) else ""


def map_shape_of(metadata: Mapping[str, Any]) -> tuple[int, int] | None:
    """Rows and columns of the maps that an estimator learned from; None where its file does not say."""
    shape = mapping_in(metadata, "data").get("shape")
    if not isinstance(shape, Sequence) or len(shape) != 2 or not all(COUNT.allows(side) for side in shape):
        return None
    return shape[0], shape[1]


def trained_on(metadata: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The data sets that an estimator was fitted to last, as ``DataSource`` describes them."""
    listed = _mappings(metadata, "training_data")
    # Files of before these were listed have the metadata of one alone, and those of others may have nothing.
    data = mapping_in(metadata, "data")
    return listed or ([data] if data else [])


def trained_before_on(metadata: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Further data sets, that those estimators were fitted to which an estimator goes on from."""
    return _mappings(metadata, "earlier_data")


def _mappings(metadata: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    return [entry for entry in mapping_in(metadata, name).values() if isinstance(entry, Mapping)]


def share_worlds(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two data sets are known to have simulated worlds in common: numbers of one split of one environment."""
    if any(one.get(name) != other.get(name) for name in ("environment", "split")):
        return False
    mine, its = _world_numbers(one), _world_numbers(other)
    return max(mine.start, its.start) < min(mine.stop, its.stop)


def _world_numbers(data: Mapping[str, Any]) -> range:
    """Numbers of a data set's worlds; none where it does not say them, as robots' logs do not."""
    first, count = data.get("first_world"), data.get("worlds")
    return range(first, first + count) if isinstance(first, int) and isinstance(count, int) else range(0)


def nearest_of(metadata: Mapping[str, Any]) -> bool | None:
    """Whether an estimator learned from labels by which the nearest ways alone count (``DatasetMetadata.nearest``).

    Args:
        metadata: of the estimator's file.

    Returns:
        None where the file does not say how its labels were made.
    """
    data = mapping_in(metadata, "data")
    if not isinstance(data.get("collection"), Mapping):
        return None
    # As of data sets: those that do not say it were labelled when there was no other way.
    return bool(data["collection"].get("nearest", False))


def nearest_misfit(metadata: Mapping[str, Any], nearest: bool) -> str | None:
    """How the labels that an estimator learned from differ from others.

    Args:
        metadata: of the estimator's file.
        nearest: whether by the other labels the nearest ways alone count.

    Returns:
        What to say, with the remedy; None where both are of one kind, or the file does not say.
    """
    learned = nearest_of(metadata)
    if learned is None or learned == nearest:
        return None
    ways = {True: "the nearest ways to a class alone count", False: "all ways to a class count"}
    return (
        f"by its labels {ways[nearest]}, by those that the estimator learned from {ways[learned]}: collect with "
        f"--set nearest={str(learned).lower()}"
    )
