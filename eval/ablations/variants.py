"""What is compared: a network and its data, each without one thing that the whole has."""

import dataclasses

FAMILY: str = "firefighting"

_COMMON = ("spacing=[10,120]", "staying_sets=3", "worlds_per_shard=20")
_EXPLORER = (*_COMMON, "views_per_world=5", "pursued=2", "look_every=0")


@dataclasses.dataclass(frozen=True, kw_only=True)
class DataSet:
    """What ``potlp collect`` is told.

    Attributes:
        split, first, worlds: of which worlds, and how many.
        settings: of the collection.
        driver: the folder of the fit whose estimator drives; None: the explorer does.
    """

    split: str
    first: int
    worlds: int
    settings: tuple[str, ...] = _EXPLORER
    driver: str | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Variant:
    """One estimator.

    Attributes:
        says: what it is, as the table has it.
        data: names of ``DATA_SETS`` that it is fitted to.
        network: settings of the fit's network and training.
        epochs: over all of its data.
    """

    says: str
    data: tuple[str, ...] = ("explored", "driven")
    network: tuple[str, ...]
    epochs: int = 2


# As in the recipe of the shipped estimator, with another number of views.
_BUILDING = (
    "network.kind=building",
    "network.widths=[24,32,48,64,96]",
    "network.blocks=[0,0,1,1,2]",
    "network.decoder=32",
    "training.views_per_batch=16",
    "training.samples_per_view=48",
    "training.learning_rate=1.5e-3",
    "training.weighting=0",
    "training.augmentation.brightness=0.1",
    "training.augmentation.colour=0.08",
    "training.patience=0",
)
_WHOLE = (*_BUILDING, "network.contrast=24", "network.raw=0")
# As in the recipe of firefighting-panorama.
_PANORAMA = ("network.kind=panorama", "network.exclusive_within=16", "training.patience=10")

FIRST: str = "first"
"""The fit whose estimator drives when data are collected with the policy in the loop."""

DATA_SETS: dict[str, DataSet] = {
    "explored": DataSet(split="training", first=80_000, worlds=1200),
    # Beside one another: as many views, by the policy and by the explorer.
    "driven": DataSet(
        split="training",
        first=81_500,
        worlds=400,
        settings=(*_COMMON, "views_per_world=10", "drives=1"),
        driver=FIRST,
    ),
    "further": DataSet(split="training", first=82_000, worlds=400),
    "choosing": DataSet(split="validation", first=6000, worlds=40),
}
"""All of them, by name; ``choosing`` has the worlds that choose the parameters of every fit."""

VARIANTS: dict[str, Variant] = {
    "whole": Variant(says="nothing left out", network=_WHOLE),
    "no-aggregation": Variant(
        says="no drives of the policy's own; as many views of the explorer",
        data=("explored", "further"),
        network=_WHOLE,
    ),
    "no-painting": Variant(
        says="no pictures: nothing painted on the map", network=(*_WHOLE, "network.without=[painting]")
    ),
    "no-map": Variant(says="no map: one panorama (the paper's kind), at its own settings", network=_PANORAMA),
    "no-paths": Variant(says="no paths through the imagined building", network=(*_WHOLE, "network.without=[paths]")),
    "no-contrast": Variant(
        says="no comparison of colours across the building", network=(*_BUILDING, "network.contrast=0", "network.raw=0")
    ),
    "one-epoch": Variant(says="half of the passes", network=_WHOLE, epochs=1),
    "six-epochs": Variant(says="three times the passes", network=_WHOLE, epochs=6),
}
"""What is fitted, by name; all differences are to the first."""

START = Variant(says="", data=("explored",), network=_WHOLE, epochs=1)
"""What drives in ``driven``."""
