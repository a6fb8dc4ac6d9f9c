"""A trained estimator as it is read from a file, and which one belongs to which worlds.

``TrainedEstimator`` lives on the host; ``start`` gives the pytree that a decision calls inside jit, with the panoramas
seen so far (``learning.architectures``). Which propositions an estimator knows, and which worlds it serves, its
file says.
"""

import dataclasses
import functools
import hashlib
import warnings
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, cast

from potlp_jax import plugins
from potlp_jax.errors import EstimatorError, PluginError, PotlpWarning
from potlp_jax.learning.architectures import EstimatorConfig, architecture_of
from potlp_jax.learning.domain import Domain
from potlp_jax.learning.network import Params, require_propositions
from potlp_jax.learning.observing import ObservingEstimator
from potlp_jax.learning.serialization import load_estimator
from potlp_jax.planning.estimates import Estimator


@dataclasses.dataclass(frozen=True)
class TrainedEstimator:
    """An estimator read from a file, for worlds of ``domain``. ``name`` and ``digest`` (of the file) identify it in
    records."""

    params: Params
    config: EstimatorConfig
    domain: Domain
    metadata: Mapping[str, Any]
    name: str
    digest: str

    @property
    def identity(self) -> str:
        """Name and digest, as in records."""
        return f"{self.name} {self.digest}"

    def start(self, height: int, width: int, panoramas: int, resolution: float) -> ObservingEstimator:
        """The estimator for a new trial: nothing observed yet.

        Args:
            height, width: of the map's array.
            panoramas: how many are remembered, by a panorama network.
            resolution: side of a cell in the unit of cost; a building network looks at cells of its own size.

        Returns:
            What a decision calls inside jit.
        """
        return architecture_of(self.config).start(self.params, self.config, height, width, panoramas, resolution)


def read_estimator(path: Path) -> TrainedEstimator:
    """Read an estimator. Raises EstimatorError where the file is none."""
    # Which file it is now: a fit may have written another one under the name since it was read.
    state = path.stat() if path.exists() else None
    return _read(path, None if state is None else (state.st_mtime_ns, state.st_size, state.st_ino))


@functools.lru_cache(maxsize=8)
def _read(path: Path, state: tuple[int, int, int] | None) -> TrainedEstimator:
    # A digest and not the name: two files of one name are two estimators in records.
    params, config, domain, metadata = load_estimator(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    return TrainedEstimator(
        params=params, config=config, domain=domain, metadata=metadata, name=path.stem, digest=digest
    )


def named_estimator(name: str | Path) -> TrainedEstimator | Estimator:
    """An estimator by the name that a command line or a sweep's file gives.

    Args:
        name: a file; or the name of a shipped one; or ``module:attribute``, or an entry point in the group
            ``potlp_jax.estimators``, of a ``TrainedEstimator``, of a function or other pytree that can be called as an
            ``Estimator``, or of a class without arguments whose objects can.

    Returns:
        The estimator.

    Raises:
        EstimatorError: there is no such file and none of that name is shipped, or the file is no estimator.
        PluginError: it cannot be imported, or is no estimator.
    """
    path = Path(name)
    # A file goes first: its name may well contain a colon.
    if path.is_file() or str(name) in shipped_files():
        return read_estimator(estimator_file(name))
    if not plugins.is_known(str(name), plugins.ESTIMATORS):
        raise EstimatorError(
            f"there is no estimator {name}: give a file (potlp fit makes one), module:attribute, or the name of one "
            f"that is shipped or installed: {', '.join([*shipped_files(), *plugins.entry_points(plugins.ESTIMATORS)])}"
        )
    found = plugins.load(str(name), group=plugins.ESTIMATORS, kind="estimator")
    estimator = found() if isinstance(found, type) else found
    if isinstance(estimator, TrainedEstimator):
        return estimator
    if not callable(estimator):
        raise PluginError(
            f"estimator {name}: {type(estimator).__name__} cannot be called with belief, subgoals and task"
        )
    # Its signature is checked when it is called.
    return cast(Estimator, estimator)


def identity_of(estimator: TrainedEstimator | Estimator) -> str:
    """What records and stores know an estimator by: name and digest of a file, ``module:attribute`` of a function."""
    if isinstance(estimator, TrainedEstimator):
        return estimator.identity
    # A plain function goes through jit as a ``Partial``, which is a pytree without leaves.
    return plugins.reference_of(estimator)


@functools.cache
def shipped_files() -> dict[str, Path]:
    """The files of the estimators that come with the package, by name."""
    folder = Path(str(resources.files("potlp_jax.learning"))) / "data"
    return {path.stem: path for path in sorted(folder.glob("*.npz"), key=lambda path: path.stem)}


def estimator_file(name: str | Path) -> Path:
    """The file that is meant by a path, or by the name of a shipped estimator; a file goes first."""
    path = Path(name)
    return path if path.is_file() else shipped_files().get(str(name), path)


def shipped_estimators() -> tuple[TrainedEstimator, ...]:
    """All that come with the package, by name."""
    # What an estimator knows and serves stands in its file, so a new shipped file needs no line of code.
    return tuple(read_estimator(path) for path in shipped_files().values())


def shipped_estimator(propositions: tuple[str, ...], here: Domain) -> TrainedEstimator | None:
    """The estimator that comes with the package for these propositions, in this order, and serves these worlds."""
    knowing = _defaults_knowing(propositions)
    return next((estimator for estimator in knowing if not estimator.domain.misfits(here)), None)


def why_none_is_shipped(propositions: tuple[str, ...], here: Domain) -> str:
    """Why ``shipped_estimator`` finds none, in words: none knows the propositions, or those that do serve others."""
    knowing = _defaults_knowing(propositions)
    if not knowing:
        return f"no estimator is shipped for the propositions {', '.join(propositions)}"
    reasons = {estimator.name: " and ".join(estimator.domain.misfits(here)) for estimator in knowing}
    return "; ".join(f"the shipped estimator {name} knows the propositions, but {why}" for name, why in reasons.items())


def _defaults_knowing(propositions: tuple[str, ...]) -> list[TrainedEstimator]:
    """Of the shipped estimators those with these propositions that have the name of their family.

    Others of a family, such as ``firefighting-panorama``, are there to be compared with, and asked by name alone.
    """
    return [
        estimator
        for estimator in shipped_estimators()
        if estimator.config.propositions == propositions and estimator.name == estimator.domain.family
    ]


def estimator_for(
    propositions: tuple[str, ...], here: Domain, given: TrainedEstimator | None = None
) -> TrainedEstimator:
    """The estimator to use for a task in some worlds: the one given, else the shipped one that serves them.

    Args:
        propositions: of the task.
        here: the worlds.
        given: is used wherever it is asked for.

    Returns:
        One over exactly these propositions.

    Raises:
        EstimatorError: none is shipped for these.
        PropositionsError: the one given knows other propositions.

    Warns:
        PotlpWarning: the one given was made for other worlds.
    """
    estimator = shipped_estimator(propositions, here) if given is None else given
    if estimator is None:
        raise EstimatorError(
            f"{why_none_is_shipped(propositions, here)}: choose another policy, or name the estimator to ask "
            f"({', '.join(shipped_files())}, or one of your own: docs/estimator.md)"
        )
    require_propositions(estimator.config.propositions, propositions, f"estimator {estimator.name}")
    misfits = estimator.domain.misfits(here)
    if misfits:
        # From this one place, so that Python shows it once and not for every trial.
        warnings.warn(
            f"estimator {estimator.name!r} is asked about worlds that it was not made for: {'; '.join(misfits)}",
            PotlpWarning,
            stacklevel=1,
        )
    return estimator
