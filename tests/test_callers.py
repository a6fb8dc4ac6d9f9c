"""What a caller's own program may ask of the planner: sharding with its checks on, and keys used once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

import potlp_jax
from potlp_jax import BestFirstConfig, DecisionConfig, FrontierConfig, SensorConfig, Start, UctConfig
from potlp_jax.learning.estimator import TrainedEstimator
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig
from potlp_jax.trials.config import TrialConfig
from tests.reference.domains import domain_of
from tests.reference.toy_plan import TASK, C, S, plan

TOY = potlp_jax.make("toy")
NETWORK = NetworkConfig(
    propositions=TOY.propositions, first_widths=(4,) * 4, second_widths=(4,) * 8, dense_widths=(8,) * 4, fovea=3
)


@pytest.mark.parametrize("config", [BestFirstConfig(simulations=20), UctConfig(simulations=20)])
def test_a_search_within_shard_map_is_the_search(config):
    """With ``check_vma`` as it is by default: each loop's carry is marked as varying from its start."""
    chances = jnp.asarray(np.random.default_rng(0).uniform(0.1, 0.9, (4, S, C)), jnp.float32)
    keys = jax.random.split(jax.random.key(0), 4)
    plans = jax.vmap(lambda chances, key: plan(chances, key, config))
    rows = PartitionSpec("rows")
    sharded = jax.shard_map(plans, mesh=Mesh(np.array(jax.devices()[:1]), ("rows",)), in_specs=rows, out_specs=rows)
    found, expected = jax.jit(sharded)(chances, keys), jax.jit(plans)(chances, keys)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)


def test_no_key_is_used_twice():
    """In a trial and in a batch of trials: keys of worlds, of the camera's disturbance and of the sampling search."""
    settings = TrialConfig(
        sensor=SensorConfig(range_cells=5.0),
        decision=DecisionConfig(frontiers=FrontierConfig(max_subgoals=4), search=UctConfig(simulations=20)),
    )
    with jax.debug_key_reuse(True):
        key = jax.random.key(0)
        jax.random.normal(key)
        with pytest.raises(jax.errors.KeyReuseError):
            jax.random.uniform(key)
        params = EstimatorNetwork(NETWORK).init(jax.random.key(0))
        estimator = TrainedEstimator(
            params=params, config=NETWORK, domain=domain_of("toy"), metadata={}, name="untrained", digest=""
        )
        trial = potlp_jax.run(TOY, 2, "potlp", config=settings, estimator=estimator)
        start = Start(TOY.world(0), TASK.arrays, jax.random.key(0), name=0)
        (finished,) = potlp_jax.run_batch([start], "potlp", settings, slots=1, estimator=estimator)
    assert (trial.outcome, finished.outcome) == ("satisfied", "satisfied")
