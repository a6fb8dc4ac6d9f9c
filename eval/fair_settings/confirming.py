"""The best of many settings once more, in worlds that did not choose it."""

from collections.abc import Sequence
from pathlib import Path

from eval.fair_settings.choosing import results
from eval.fair_settings.running import CONFIRMING, Trials
from eval.fair_settings.settings import Setting
from potlp_jax.environments.base import Generator
from potlp_jax.planning.policies import Policy


def confirm(
    family: Generator,
    policies: Sequence[str],
    worlds: int,
    folder: Path,
    estimator: str | None = None,
    tasks: Sequence[str] | None = None,
) -> None:
    """Run what is missing of the best setting of each policy, and of its default, where the two differ.

    Args:
        family: of the worlds.
        policies: names.
        worlds: how many, from number ``CONFIRMING``.
        folder: with the rows of ``running.run``; gets those of these trials.
        estimator: as there.
        tasks: as there.
    """
    trials = Trials(family, list(family.tasks) if tasks is None else tasks, folder, estimator)
    others = range(CONFIRMING, CONFIRMING + worlds)
    found = results(folder)["families"][family.name]["policies"]
    for policy in policies:
        finalists = _finalists(found[policy]["default"], found[policy]["best"])
        if len(finalists) == 1:
            continue
        # The known map, which has no settings, says in which worlds a task is possible.
        trials.run(Policy.KNOWN_MAP, trials.settings(Policy.KNOWN_MAP, (), (), ())[0], others)
        for setting in finalists:
            trials.run(policy, setting, others)
            print(f"{family.name}, worlds to {others[-1]}: {policy} {setting}", flush=True)


def _finalists(*settings: Sequence[float]) -> list[Setting]:
    return list(dict.fromkeys((int(size), distance, commitment) for size, distance, commitment in settings))
