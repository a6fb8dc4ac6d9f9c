"""The network's symmetries, shapes and bounds, against loops and images that were really rolled."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.codec import config_from_dict, json_copy
from potlp_jax.errors import ConfigurationError, NetworkError
from potlp_jax.learning.network import STRIDE, EstimatorNetwork, NetworkConfig, operation_counts, parameter_count

pytestmark = pytest.mark.optimised

CONFIG = NetworkConfig(
    propositions=("fire", "alarm", "exit"),
    image_shape=(64, 128),
    first_widths=(6, 8, 8, 10),
    second_widths=(8, 8, 8, 8, 12, 12, 12, 12),
    dense_widths=(16, 12, 12, 8),
)
NETWORK = EstimatorNetwork(CONFIG)
COLUMNS = CONFIG.feature_shape[1]


# Operation by operation they would be hundreds of programs.
_init = jax.jit(EstimatorNetwork.init, static_argnums=0)
_encode = jax.jit(EstimatorNetwork.encode, static_argnums=0)
_answer = jax.jit(EstimatorNetwork.answer, static_argnums=0)


@pytest.fixture(scope="module")
def params():
    return _init(NETWORK, jax.random.key(3))


def _images(count, seed=0):
    shape = (count, *CONFIG.image_shape, 3)
    return jnp.asarray(np.random.default_rng(seed).integers(0, 256, shape), jnp.uint8)


def _questions(shape, seed=1):
    random = np.random.default_rng(seed)
    n = len(CONFIG.propositions)
    phi = [jnp.asarray(random.integers(-1, 2, (*shape, n)), jnp.int8) for _ in range(2)]
    bearing = jnp.asarray(random.uniform(-np.pi, np.pi, shape), jnp.float32)
    return bearing, jnp.asarray(random.uniform(0, 60, shape), jnp.float32), *phi


def _centred(network, params, image, bearing, distance):
    """Of one image toward subgoals, or of several, each toward its own."""
    centre = network.centre if image.ndim == 3 else jax.vmap(network.centre)
    return jax.jit(centre)(_encode(network, params, image), bearing, distance)


def _answers(params, image, bearing, distance, phi_stay, phi_go):
    return _answer(NETWORK, params, _centred(NETWORK, params, image, bearing, distance), phi_stay, phi_go)


@pytest.mark.parametrize("columns", [1, 3, -2])
def test_rolling_the_image_by_whole_strides_rolls_the_features_exactly(params, columns):
    image = _images(2)
    encode = jax.jit(NETWORK.encode)
    features = encode(params, image)
    rolled = encode(params, jnp.roll(image, columns * STRIDE, axis=-2))
    np.testing.assert_array_equal(rolled, jnp.roll(features, columns, axis=-2))
    assert not np.array_equal(rolled, features)


def test_rolling_by_part_of_a_stride_is_no_roll_of_the_features(params):
    image = _images(1)
    features = NETWORK.encode(params, image)
    moved = NETWORK.encode(params, jnp.roll(image, STRIDE // 2, axis=-2))
    assert all(not np.allclose(moved, jnp.roll(features, k, axis=-2), atol=1e-3) for k in range(COLUMNS))


def test_a_turned_world_with_turned_bearings_gives_the_same_answers(params):
    # The whole network, not only the first stage: image and bearing turn together by one column of the features.
    image = _images(4)
    bearing, *rest = _questions((4,))
    turned = bearing + jnp.float32(2 * np.pi / COLUMNS)
    one = _answers(params, image, bearing, *rest)
    other = _answers(params, jnp.roll(image, STRIDE, axis=-2), turned, *rest)
    np.testing.assert_allclose(one.success_logit, other.success_logit, atol=1e-5)
    assert float(jnp.std(one.success_logit)) > 1e-3


def test_centring_brings_the_bearing_into_the_centre():
    # Features that hold the bearing of their own column's centre.
    step = 2 * np.pi / COLUMNS
    own = (np.arange(COLUMNS) + 0.5) * step - np.pi
    features = jnp.broadcast_to(jnp.asarray(own, jnp.float32)[None, :, None], (4, COLUMNS, 1))
    bearings = np.linspace(-2 * np.pi, 2 * np.pi, 41).astype(np.float32)
    centred = NETWORK.centre(features, jnp.asarray(bearings), jnp.zeros(41))
    assert centred.features.shape == (41, 4, COLUMNS, 1)
    assert float(jnp.max(jnp.abs(centred.residual))) <= step / 2 + 1e-5
    # The centre of the picture is the line between the two middle columns.
    left, right = (np.asarray(centred.features[:, 0, COLUMNS // 2 - side, 0]) for side in (1, 0))
    centre = np.angle(np.exp(1j * left) + np.exp(1j * right))
    error = np.angle(np.exp(1j * (centre + np.asarray(centred.residual) - bearings)))
    np.testing.assert_allclose(error, 0, atol=1e-5)


def test_the_fovea_changes_answers_and_nothing_of_a_network_without_it(params):
    network = EstimatorNetwork(dataclasses.replace(CONFIG, fovea=5))
    keen = _init(network, jax.random.key(3))
    image, (bearing, distance, *phi) = _images(1), _questions((1,))
    centred = _centred(network, keen, image, bearing, distance)
    without = _centred(NETWORK, params | {"first": keen["first"]}, image, bearing, distance)
    np.testing.assert_array_equal(centred.features, without.features)
    assert without.fovea is None
    answer = _answer(network, keen, centred, *phi)
    blind = _answer(network, keen, dataclasses.replace(centred, fovea=jnp.zeros_like(centred.fovea)), *phi)
    assert float(answer.success_logit[0]) != float(blind.success_logit[0])


def test_what_the_fovea_says_depends_on_who_is_looked_for(params):
    """Two patches differ by one amount for one phi and by another for another: the condition does more than add."""
    network = EstimatorNetwork(dataclasses.replace(CONFIG, fovea=5))
    keen = _init(network, jax.random.key(3))
    bearing, distance, stay, go = _questions((1,))
    centred = _centred(network, keen, _images(1), bearing, distance)
    other = dataclasses.replace(centred, fovea=-centred.fovea)

    def difference(go):
        pair = [_answer(network, keen, seen, stay, go).success_logit[0] for seen in (centred, other)]
        return float(pair[0] - pair[1])

    assert difference(go) != pytest.approx(difference(-go), rel=1e-2)


def test_one_call_over_subgoals_and_classes_equals_a_loop(params):
    subgoals, classes = 3, 4
    image = _images(1)[0]
    bearing, distance, _, _ = _questions((subgoals,))
    _, _, stay, go = _questions((classes,), seed=7)
    pairs = (subgoals, classes)
    centred = _centred(NETWORK, params, image, bearing, distance)
    answers = NETWORK.answer(
        params,
        jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:, None], (*pairs, *leaf.shape[1:])), centred),
        jnp.broadcast_to(stay[None], (*pairs, 3)),
        jnp.broadcast_to(go[None], (*pairs, 3)),
    )
    for s in range(subgoals):
        for c in range(classes):
            alone = _answers(params, image, bearing[s], distance[s], stay[c], go[c])
            for field in ("success_logit", "success_cost", "failure_cost"):
                np.testing.assert_allclose(getattr(answers, field)[s, c], getattr(alone, field), rtol=1e-4, atol=1e-5)
    assert len(np.unique(np.asarray(answers.success_logit))) == subgoals * classes


def test_every_input_counts(params):
    image = _images(1)[0]
    bearing, distance, stay, go = _questions(())
    base = _answers(params, image, bearing, distance, stay, go).success_logit
    changed = {
        "image": _answers(params, _images(1, 9)[0], bearing, distance, stay, go),
        "bearing": _answers(params, image, bearing + jnp.float32(1.5), distance, stay, go),
        "part of a column": _answers(params, image, bearing + jnp.float32(0.02), distance, stay, go),
        "distance": _answers(params, image, bearing, distance + 10, stay, go),
        "phi_stay": _answers(params, image, bearing, distance, -stay + jnp.int8(1), go),
        "phi_go": _answers(params, image, bearing, distance, stay, -go + jnp.int8(1)),
    }
    assert [name for name, answers in changed.items() if abs(float(answers.success_logit - base)) < 1e-7] == []


@pytest.mark.long
@pytest.mark.parametrize("fovea", [0, 5])
def test_gradients_reach_every_parameter(fovea):
    network = EstimatorNetwork(dataclasses.replace(CONFIG, fovea=fovea))
    image = _images(6)
    bearing, distance, stay, go = _questions((6,))

    def total(params):
        answers = network.answer(params, _centred(network, params, image, bearing, distance), stay, go)
        return jnp.sum(answers.success_logit + answers.success_cost + answers.failure_cost)

    gradients = jax.tree_util.tree_leaves_with_path(jax.jit(jax.grad(total))(_init(network, jax.random.key(3))))
    assert [jax.tree_util.keystr(path) for path, leaf in gradients if not np.any(leaf)] == []
    assert all(np.all(np.isfinite(leaf)) for _, leaf in gradients)


@pytest.mark.parametrize("factor", [0.0, 1.0, 30.0, -30.0])
def test_costs_keep_their_bounds_whatever_the_parameters(params, factor):
    wild = jax.tree.map(lambda leaf: leaf * factor, params)
    network = EstimatorNetwork(dataclasses.replace(CONFIG, step=0.5))
    bearing, distance, stay, go = _questions((8,))
    answers = network.answer(wild, _centred(network, wild, _images(8), bearing, distance * 1e3), stay, go)
    assert np.all(np.asarray(answers.success_cost) >= 0.5)
    assert np.all(np.asarray(answers.failure_cost) >= 0)
    assert np.all((answers.success_probability >= 0) & (answers.success_probability <= 1))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(answers))


def test_operations_and_parameters_counted_by_hand():
    config = NetworkConfig(
        propositions=("a",),
        image_shape=(64, 64),
        first_widths=(1, 2, 3, 4),
        second_widths=(1,) * 8,
        dense_widths=(2, 2, 2, 2),
    )
    first, second = operation_counts(config)
    # Sizes 16x16, 8x8, 4x4, 4x4 with kernels 4, 2, 3, 3.
    assert first == 2 * (256 * 16 * 3 * 1 + 64 * 4 * 1 * 2 + 16 * 9 * 2 * 3 + 16 * 9 * 3 * 4)
    # 2x2 three more times, 1x1 four times; condition: phi twice, distance, sine, cosine.
    convolutions = 4 * 9 * 4 + 3 * 4 * 9 + 4 * 1 * 9
    assert second == 2 * (convolutions + 5 * 1 + 1 * 2 + 3 * 2 * 2 + 2 * 3)
    kernels = 48 * 1 + 4 * 2 + 18 * 3 + 27 * 4 + 9 * 4 + 7 * 9 + 5 + 1 * 2 + 3 * 4 + 6
    biases = (1 + 2 + 3 + 4) + 8 + 4 * 2 + 3
    position = 4
    _, wide = operation_counts(dataclasses.replace(config, fovea=1))
    # Twelve bands of three columns; scale and shift of both layers by the condition.
    assert wide - second == 2 * ((12 * 3 * 3 + 2 * 5) * 256 + (256 + 2 * 5) * 128 + 128 * 2)
    shapes = jax.eval_shape(EstimatorNetwork(config).init, jax.random.key(0))
    assert parameter_count(shapes) == kernels + biases + position


def test_configuration_survives_json():
    data = json_copy(dataclasses.asdict(CONFIG))
    assert config_from_dict(NetworkConfig, data, "network") == CONFIG
    del data["step"]
    with pytest.raises(ConfigurationError, match="network: step is missing"):
        config_from_dict(NetworkConfig, data, "network")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"first_widths": (8, 8, 8)}, "first_widths"),
        ({"second_widths": (8,) * 7 + (0,)}, "second_widths"),
        ({"dense_widths": (8,)}, "dense_widths"),
        ({"image_shape": (128, 500)}, "multiples of 64"),
        ({"propositions": ()}, "propositions"),
        ({"fovea": 64}, "fovea"),
        ({"horizon": float("inf")}, "horizon"),
        ({"fold": 0.0}, "fold"),
        ({"exclusive_within": -1.0}, "exclusive_within"),
        ({"success_cost_scale": float("nan")}, "success_cost_scale"),
    ],
)
def test_configurations_that_do_not_fit_are_refused(change, message):
    with pytest.raises(NetworkError, match=message):
        dataclasses.replace(CONFIG, **change)


def test_other_shapes_of_input_are_refused_by_name(params):
    with pytest.raises(NetworkError, match=r"\(64, 64\).*\(64, 128\)"):
        NETWORK.encode(params, jnp.zeros((1, 64, 64, 3), jnp.uint8))
    centred = NETWORK.centre(jnp.zeros(CONFIG.feature_shape), jnp.zeros(1), jnp.zeros(1))
    phi = jnp.zeros((1, 2), jnp.int8)
    with pytest.raises(NetworkError, match="fire, alarm, exit"):
        NETWORK.answer(params, centred, phi, phi)
