"""PO-TLP's decision with a trained network by phase: what looking and asking cost, beside what planning costs."""

import dataclasses

import jax

from potlp_jax.bench.planner import PhaseRow, Phases, Scene, measure_decision, world_of
from potlp_jax.learning.estimator import NetworkEstimator, TrainedEstimator
from potlp_jax.learning.memory import remember
from potlp_jax.learning.network import EstimatorNetwork
from potlp_jax.planning.policies import DecisionConfig, Policy, assess
from potlp_jax.trials.robot import photograph
from potlp_jax.world.camera import CameraConfig, Disturbance


def measure_looking(
    scene: Scene, trained: TrainedEstimator, config: DecisionConfig, repeats: int, camera: CameraConfig = CameraConfig()
) -> list[PhaseRow]:
    """The phases of looking, in their order, then those of the decision (``measure_decision``) with what was seen.

    * render: the panorama, in the simulator
    * first stage: the network's features of the panorama, once per look
    * remember: which cells are in sight, and a place in memory
    * ways to subgoals: their distances from where the panoramas were taken, part of the estimates
    * estimates: the second stage, for every subgoal and outcome class
    """
    world, key = world_of(scene), jax.random.key(0)
    network = EstimatorNetwork(trained.config)
    phases = Phases(repeats)
    panorama = phases.measure(
        "render", lambda world, cell: photograph(world, cell, key, camera, Disturbance()), world, scene.cell
    )
    blind = trained.start(*world.shape)
    features = phases.measure(
        "first stage", lambda params, image: network.encode(params, image), trained.params, panorama
    )
    views = phases.measure("remember", remember, blind.views, features, scene.belief, scene.cell)
    estimator = NetworkEstimator(params=trained.params, views=views, config=trained.config)
    subgoals = assess(scene.belief, scene.cell, scene.state, scene.task, config.frontiers).subgoals
    phases.measure(
        "ways to subgoals",
        lambda estimator, belief, subgoals: estimator.distances(belief, subgoals),
        estimator,
        scene.belief,
        subgoals,
    )
    seeing = dataclasses.replace(scene, estimator=estimator)
    return [*phases.rows, *measure_decision(seeing, config, repeats, Policy.POTLP)]
