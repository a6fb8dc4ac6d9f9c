"""The camera's bearings, what disturbs its pictures, and settings that are no camera."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.world.camera import CameraConfig, Disturbance, bearing, disturb

pytestmark = pytest.mark.optimised


def test_bearings_of_several_targets():
    targets = jnp.asarray(np.array([[4, 9], [9, 4], [4, 0], [0, 4], [4, 4]], np.int32))
    wanted = [0.0, math.pi / 2, math.pi, -math.pi / 2, 0.0]
    np.testing.assert_allclose(bearing(jnp.asarray(np.array([4, 4], np.int32)), targets), wanted, atol=1e-6)


def grey_picture() -> jax.Array:
    return jnp.full((64, 64, 3), 120, jnp.uint8)


def test_no_disturbance_changes_nothing():
    picture = jnp.asarray(np.random.default_rng(1).integers(0, 256, (16, 24, 3), np.uint8))
    np.testing.assert_array_equal(disturb(picture, jax.random.key(0), Disturbance()), picture)


def test_noise_exposure_and_colour_are_what_they_are_called():
    keys = jax.random.split(jax.random.key(1), 200)
    noisy = np.asarray(disturb(grey_picture(), keys[0], Disturbance(noise=6.0))).astype(float)
    assert noisy.std() == pytest.approx(6.0, rel=0.05)
    assert noisy.mean() == pytest.approx(120, abs=0.5)
    exposed = np.asarray(jax.vmap(lambda key: disturb(grey_picture(), key, Disturbance(exposure=0.1)))(keys)).astype(
        float
    )
    assert (exposed == exposed[:, :1, :1, :1]).all()
    assert np.log(exposed[:, 0, 0, 0] / 120).std() == pytest.approx(0.1, rel=0.2)
    tinted = np.asarray(jax.vmap(lambda key: disturb(grey_picture(), key, Disturbance(colour=0.1)))(keys)).astype(float)
    assert (tinted == tinted[:, :1, :1]).all()
    channels = np.log(tinted[:, 0, 0] / 120)
    assert channels.std() == pytest.approx(0.1, rel=0.2)
    assert abs(np.corrcoef(channels.T)[0, 1]) < 0.25


def test_a_disturbance_belongs_to_its_key():
    config = Disturbance(noise=4.0, exposure=0.1, colour=0.05)
    first = disturb(grey_picture(), jax.random.key(3), config)
    np.testing.assert_array_equal(disturb(grey_picture(), jax.random.key(3), config), first)
    assert (np.asarray(disturb(grey_picture(), jax.random.key(4), config)) != np.asarray(first)).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 100}, "multiple of 8"),
        ({"height": 0}, "height"),
        ({"eye_height": 2.5}, "below the ceiling"),
        ({"far": 0.0}, "positive"),
        ({"ambient": 1.5}, "ambient"),
        ({"smoke_colour": (1, 2, 300)}, "colour"),
    ],
)
def test_bad_cameras_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        CameraConfig(**change)


def test_bad_disturbances_are_refused():
    with pytest.raises(ValueError, match="noise"):
        Disturbance(noise=-1.0)
