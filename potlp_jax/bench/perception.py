"""PO-TLP's decision with a trained network by phase: what camera and network cost, beside what planning costs."""

import dataclasses

import jax

from potlp_jax.bench.planner import PhaseRow, Phases, Scene, measure_decision, world_of
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.observing import with_memory
from potlp_jax.planning.policies import Policy
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.robot import photograph
from potlp_jax.world.camera import Disturbance


def measure_perception(scene: Scene, trained: TrainedEstimator, config: TrialConfig, repeats: int) -> list[PhaseRow]:
    """The phases of perception, in their order, then those of the decision (``measure_decision``) with what was seen.

    * render: the panorama, in the simulator
    * encode: what the estimator makes of the panorama alone, once per observation
    * remember: what it then keeps, on the map or in its list of panoramas
    * estimates: the answers, for every subgoal and outcome class

    Args:
        scene: a scene with the true map's estimator, which holds the world to render.
        trained: the network.
        config: settings of a trial. Its camera must be the one that the network was trained with.
        repeats: timed runs of each phase.

    Returns:
        A row for each phase, then those of the decision.
    """
    # Phases are fed with what those before returned, so the estimator below answers from a real observation.
    world, key = world_of(scene), jax.random.key(0)
    phases = Phases(repeats)
    panorama = phases.measure(
        "render", lambda world, cell: photograph(world, cell, key, config.camera, Disturbance()), world, scene.cell
    )
    # An estimator before its first observation: an empty memory of the right size.
    blind = trained.start(*world.shape, config.panoramas, float(world.resolution))
    seen = phases.measure("encode", lambda estimator, image: estimator.encode(image), blind, panorama)
    memory = phases.measure(
        "remember",
        lambda estimator, seen, belief, cell: estimator.remember(seen, belief, cell).memory,
        blind,
        seen,
        scene.belief,
        scene.cell,
    )
    # The same scene with the network instead of the true map: its "estimates" phase is the network's answers.
    seeing = dataclasses.replace(scene, estimator=with_memory(blind, memory))
    return [*phases.rows, *measure_decision(seeing, config.decision, repeats, Policy.POTLP)]
