"""PO-TLP's decision with a trained network by phase: what looking and asking cost, beside what planning costs."""

import jax
from jaxtyping import Array

from potlp_jax.bench.planner import PhaseRow, Phases, Scene, world_of
from potlp_jax.learning.estimator import NetworkEstimator, TrainedEstimator
from potlp_jax.learning.network import EstimatorNetwork
from potlp_jax.learning.views import remember
from potlp_jax.planning.policies import DecisionConfig, Move, Policy, assess, decide
from potlp_jax.robot import photograph
from potlp_jax.world.panorama import CameraConfig, Disturbance


def measure_looking(
    scene: Scene, trained: TrainedEstimator, config: DecisionConfig, repeats: int, camera: CameraConfig = CameraConfig()
) -> list[PhaseRow]:
    """The phases that the network adds to a decision, in their order, then looking and deciding as a whole.

    * render: the panorama, in the simulator
    * first stage: the network's features of the panorama, once per look
    * remember: which cells are in sight, and a place in memory
    * ways to subgoals: their distances from where the panoramas were taken, part of the next
    * estimates: the second stage, for every subgoal and outcome class
    * whole: all of that, and the planning of ``measure_decision``
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
    phases.measure(
        "estimates",
        lambda estimator, belief, subgoals, task: estimator(belief, subgoals, task),
        estimator,
        scene.belief,
        subgoals,
        scene.task,
    )

    def whole(scene: Scene, estimator: NetworkEstimator, key: Array) -> tuple[Move, NetworkEstimator]:
        image = photograph(world_of(scene), scene.cell, key, camera, Disturbance())
        estimator = estimator.look(image, scene.belief, scene.cell)
        move = decide(
            scene.belief, scene.cell, scene.state, scene.task, estimator, key, policy=Policy.POTLP, config=config
        )
        return move, estimator

    phases.measure("whole", whole, scene, blind, key)
    return phases.rows
