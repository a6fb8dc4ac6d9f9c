"""What an estimator's file says of how it was made. Metadata are anybody's JSON: what has another form says nothing."""

from collections.abc import Mapping
from typing import Any


def mapping_in(metadata: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """An entry that is a mapping; an empty one where there is none."""
    found = metadata.get(name)
    return found if isinstance(found, Mapping) else {}


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
