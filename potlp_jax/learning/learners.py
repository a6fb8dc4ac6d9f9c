"""How each architecture is trained and evaluated: the learner of a configuration."""

from potlp_jax.learning.architectures import EstimatorConfig
from potlp_jax.learning.building_learner import BuildingLearner
from potlp_jax.learning.learner import Learner
from potlp_jax.learning.network import NetworkConfig
from potlp_jax.learning.panorama_learner import PanoramaLearner


def learner_of(config: EstimatorConfig) -> Learner:
    """What shows a data set to the network of a configuration."""
    return PanoramaLearner(config) if isinstance(config, NetworkConfig) else BuildingLearner(config)
