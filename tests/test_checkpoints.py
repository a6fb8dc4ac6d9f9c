"""Checkpoints and estimators: what is written is what is read, and whatever else is refused by name."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.errors import CheckpointError, EstimatorError, PropositionsError
from potlp_jax.learning import serialization as estimator_files
from potlp_jax.learning.checkpoints import checkpoint_steps, load_checkpoint, save_checkpoint
from potlp_jax.learning.network import EstimatorNetwork, NetworkConfig, require_propositions
from potlp_jax.learning.serialization import load_estimator, save_estimator
from tests.reference.domains import domain_of

CONFIG = NetworkConfig(
    propositions=("fire", "exit"),
    image_shape=(64, 64),
    first_widths=(2, 2, 2, 3),
    second_widths=(3,) * 8,
    dense_widths=(4, 4, 4, 4),
    success_cost_scale=12.5,
)

DOMAIN = domain_of("toy")
IDENTITY = {"network": {"propositions": ["fire", "exit"]}, "versions": {"jax": "1"}}


def _state(offset=0.0):
    return {
        "params": {"kernel": jnp.arange(6, dtype=jnp.float32).reshape(2, 3) / 7 + jnp.float32(offset)},
        "step": jnp.int32(4),
        "key": jnp.array([1, 2**32 - 1], jnp.uint32),
    }


def _assert_equal(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.fixture(scope="module")
def params():
    return EstimatorNetwork(CONFIG).init(jax.random.key(0))


def test_a_checkpoint_comes_back_bit_for_bit_and_old_ones_go(tmp_path):
    for step in (1, 2, 10):
        save_checkpoint(tmp_path, step, _state(step), IDENTITY, {"seconds": step / 2})
    assert checkpoint_steps(tmp_path) == [2, 10]
    state, progress = load_checkpoint(tmp_path, 10, _state(), IDENTITY)
    _assert_equal(state, _state(10))
    assert progress == {"seconds": 5.0}
    assert checkpoint_steps(tmp_path / "nothing") == []


def test_a_checkpoint_of_the_same_step_is_replaced(tmp_path):
    save_checkpoint(tmp_path, 3, _state(1), IDENTITY, {})
    save_checkpoint(tmp_path, 3, _state(2), IDENTITY, {})
    _assert_equal(load_checkpoint(tmp_path, 3, _state(), IDENTITY)[0], _state(2))


def test_unfinished_folders_are_no_checkpoints(tmp_path):
    save_checkpoint(tmp_path, 3, _state(), IDENTITY, {})
    (tmp_path / "7.orbax-checkpoint-tmp-123").mkdir()
    assert checkpoint_steps(tmp_path) == [3]


@pytest.mark.parametrize(
    ("identity", "message"),
    [
        (
            {**IDENTITY, "network": {"propositions": ["fire", "alarm"]}},
            r'network\.propositions was \["fire", "exit"\], is \["fire", "alarm"\]',
        ),
        ({**IDENTITY, "versions": {"jax": "2"}}, r"versions\.jax was .*1.*, is .*2"),
        ({**IDENTITY, "seed": 3}, "seed was null, is 3"),
    ],
)
def test_a_checkpoint_of_another_training_is_refused_by_name(tmp_path, identity, message):
    save_checkpoint(tmp_path, 3, _state(), IDENTITY, {})
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(tmp_path, 3, _state(), identity)


def test_other_shapes_are_refused_by_name(tmp_path):
    save_checkpoint(tmp_path, 3, _state(), IDENTITY, {})
    other = {**_state(), "params": {"kernel": jnp.zeros((2, 4)), "bias": jnp.zeros(4)}}
    with pytest.raises(
        CheckpointError, match=r"params\.bias.*params\.kernel was \"float32\[2, 3\]\", is \"float32\[2, 4\]"
    ):
        load_checkpoint(tmp_path, 3, other, IDENTITY)


def test_a_damaged_file_is_found_or_did_not_matter(tmp_path):
    save_checkpoint(tmp_path, 3, _state(1), IDENTITY, {})
    found = 0
    for path in [path for path in (tmp_path / "3").rglob("*") if path.is_file()]:
        whole = path.read_bytes()
        for damaged in (whole[: len(whole) // 2], whole[:-9] + bytes(9)):
            path.write_bytes(damaged)
            try:
                _assert_equal(load_checkpoint(tmp_path, 3, _state(), IDENTITY)[0], _state(1))
            except CheckpointError:
                found += 1
        path.write_bytes(whole)
    assert found >= 4


def test_a_folder_that_is_no_checkpoint_is_refused(tmp_path):
    (tmp_path / "5").mkdir()
    with pytest.raises(CheckpointError, match="5"):
        load_checkpoint(tmp_path, 5, _state(), IDENTITY)


def test_an_estimator_comes_back_with_its_configuration(tmp_path, params):
    path = tmp_path / "deeper" / "estimator.npz"
    save_estimator(path, params, CONFIG, DOMAIN, {"figures": {"skill": 0.5}})
    loaded, config, domain, metadata = load_estimator(path)
    _assert_equal(loaded, params)
    assert (config, domain) == (CONFIG, DOMAIN)
    assert metadata == {"figures": {"skill": 0.5}}
    assert [entry.name for entry in path.parent.iterdir()] == ["estimator.npz"]


def test_the_default_network_is_shipped_in_under_ten_megabytes(tmp_path):
    config = NetworkConfig(propositions=tuple("abcdefgh"))
    shapes = jax.eval_shape(EstimatorNetwork(config).init, jax.random.key(0))
    # Random bits: nothing in the format may depend on compression.
    random = np.random.default_rng(0)
    filled = jax.tree.map(lambda leaf: random.normal(size=leaf.shape).astype(np.float32), shapes)
    save_estimator(tmp_path / "e.npz", filled, config, DOMAIN, {})
    assert (tmp_path / "e.npz").stat().st_size < 10_000_000


def test_estimators_that_are_not_whole_or_not_ours_are_refused(tmp_path, params):
    path = tmp_path / "e.npz"
    with pytest.raises(EstimatorError, match="there is no estimator"):
        load_estimator(path)
    save_estimator(path, params, CONFIG, DOMAIN, {})
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 0x10
    for damaged in (b"", b"not a zip", whole[: len(whole) // 2], bytes(flipped)):
        path.write_bytes(damaged)
        with pytest.raises(EstimatorError, match=r"e\.npz"):
            load_estimator(path)
    np.savez(path, weights=np.zeros(3))
    with pytest.raises(EstimatorError, match="not an estimator"):
        load_estimator(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_parameters_that_are_no_numbers_are_refused_by_name(tmp_path, params, value):
    """One of them reaches most estimates: every decision of a trial would be invalid."""
    leaves, structure = jax.tree.flatten(params)
    broken = jax.tree.unflatten(structure, [leaves[0].at[0].set(value), *leaves[1:]])
    save_estimator(tmp_path / "e.npz", broken, CONFIG, DOMAIN, {})
    name = next(iter(estimator_files.named_leaves(broken)))
    with pytest.raises(EstimatorError, match=rf"e\.npz: the parameter {name} holds .* NaN or infinite"):
        load_estimator(tmp_path / "e.npz")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_checkpoint_with_parameters_that_are_no_numbers_is_refused(tmp_path, value):
    """But a best loss of inf belongs to every training that has not been evaluated yet."""
    state = {"params": {"kernel": jnp.ones(3)}, "best_loss": jnp.float32(np.inf)}
    save_checkpoint(tmp_path, 1, state, IDENTITY, {})
    load_checkpoint(tmp_path, 1, state, IDENTITY)
    state["params"]["kernel"] = state["params"]["kernel"].at[1].set(value)
    save_checkpoint(tmp_path, 2, state, IDENTITY, {})
    with pytest.raises(CheckpointError, match=r"params\.kernel holds 1 values that are NaN or infinite, of 3"):
        load_checkpoint(tmp_path, 2, state, IDENTITY)


def test_an_estimator_of_another_format_or_network_is_refused_by_name(tmp_path, params, monkeypatch):
    path = tmp_path / "e.npz"
    wider = dataclasses.replace(CONFIG, dense_widths=(4, 4, 4, 5))
    save_estimator(path, params, wider, DOMAIN, {})
    with pytest.raises(EstimatorError, match=r"array\.second\.Dense_4\.bias was .*float32\[4\].*float32\[5\]"):
        load_estimator(path)
    monkeypatch.setattr(estimator_files, "ESTIMATOR_FORMAT", "potlp-estimator-99")
    save_estimator(path, params, CONFIG, DOMAIN, {})
    monkeypatch.undo()
    with pytest.raises(EstimatorError, match="'potlp-estimator-99'"):
        load_estimator(path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name != "header"}
    header = {"format": estimator_files.ESTIMATOR_FORMAT, "network": {"propositions": ["a"]}, "metadata": {}}
    np.savez(path, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
    with pytest.raises(EstimatorError, match="image_shape"):
        load_estimator(path)


def test_other_propositions_or_another_order_are_refused():
    require_propositions(CONFIG.propositions, ("fire", "exit"), "the estimator")
    for other in (("exit", "fire"), ("fire", "exit", "alarm")):
        with pytest.raises(PropositionsError, match=rf"task.*\({', '.join(other)}\), the estimator \(fire, exit\)"):
            require_propositions(CONFIG.propositions, other, "the estimator")
