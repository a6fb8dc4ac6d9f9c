"""PO-TLP's decision with a trained network by phase: what camera and network cost, beside what planning costs."""

import dataclasses

import jax

from potlp_jax.bench.planner import PhaseRow, Phases, Scene, measure_decision, world_of
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.memory import remember
from potlp_jax.learning.network import EstimatorNetwork
from potlp_jax.learning.panorama_estimator import NetworkEstimator
from potlp_jax.planning.policies import Policy
from potlp_jax.planning.situation import DecisionConfig, assess
from potlp_jax.trials.config import TrialConfig
from potlp_jax.trials.robot import photograph
from potlp_jax.world.camera import CameraConfig, Disturbance


def measure_perception(
    scene: Scene, trained: TrainedEstimator, config: DecisionConfig, repeats: int, camera: CameraConfig = CameraConfig()
) -> list[PhaseRow]:
    """The phases of perception, in their order, then those of the decision (``measure_decision``) with what was seen.

    * render: the panorama, in the simulator
    * first stage: the network's features of the panorama, once per observation
    * remember: which cells are in sight, and an entry in memory
    * distances to subgoals: from where the panoramas were taken, part of the estimates
    * estimates: the second stage, for every subgoal and outcome class

    Args:
        scene: a scene with the true map's estimator, which holds the world to render.
        trained: the network.
        config: settings of the decision.
        repeats: timed runs of each phase.
        camera: the simulated camera; it must be the one that the network was trained with.

    Returns:
        A row for each phase, then those of the decision.
    """
    # Phases are fed with what those before returned, so the estimator below answers from a real observation.
    world, key = world_of(scene), jax.random.key(0)
    network = EstimatorNetwork(trained.config)
    phases = Phases(repeats)
    panorama = phases.measure(
        "render", lambda world, cell: photograph(world, cell, key, camera, Disturbance()), world, scene.cell
    )
    # An estimator before its first observation: an empty memory of the right size.
    blind = trained.start(*world.shape, TrialConfig().panoramas)
    features = phases.measure(
        "first stage", lambda params, image: network.encode(params, image), trained.params, panorama
    )
    memory = phases.measure("remember", remember, blind.memory, features, scene.belief, scene.cell)
    estimator = NetworkEstimator(params=trained.params, memory=memory, config=trained.config)
    subgoals = assess(scene.belief, scene.cell, scene.state, scene.task, config.frontiers).subgoals
    phases.measure(
        "distances to subgoals",
        lambda estimator, belief, subgoals: estimator.distances(belief, subgoals),
        estimator,
        scene.belief,
        subgoals,
    )
    # The same scene with the network instead of the true map: its "estimates" phase is the second stage.
    seeing = dataclasses.replace(scene, estimator=estimator)
    return [*phases.rows, *measure_decision(seeing, config, repeats, Policy.POTLP)]
