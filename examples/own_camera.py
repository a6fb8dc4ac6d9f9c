"""A camera of your own: a thermal one, in which only distance and smoke are seen.

    potlp run firefighting --camera examples.own_camera:thermal --estimator firefighting

A camera is a function of the world, the robot's cell and its ``CameraConfig``, which runs inside jit. It is named, not
passed: records, data sets and the workers of a sweep all mean the same one.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32, UInt8

import potlp_jax
from potlp_jax.trials.replay import panorama_at
from potlp_jax.world.camera import CameraConfig
from potlp_jax.world.renderer import render


def thermal(world: potlp_jax.World, cell: Int32[Array, "2"], config: CameraConfig) -> UInt8[Array, "rows columns 3"]:
    """Grey levels of the usual picture without texture: bright is warm."""
    plain = render(world, cell, dataclasses.replace(config, renderer="", texture=0.0))
    # Luminance after ITU-R BT.601.
    grey = plain.astype(jnp.float32) @ jnp.array([0.299, 0.587, 0.114])
    return jnp.broadcast_to(grey[:, :, None].astype(jnp.uint8), plain.shape)


def main() -> None:
    """What a robot with the camera saw at the first decision of a trial."""
    environment = potlp_jax.make("toy")
    camera = CameraConfig(height=32, width=128, horizon=12.0, renderer="examples.own_camera:thermal")
    config = dataclasses.replace(potlp_jax.trial_config_for(environment), camera=camera)
    trial = potlp_jax.run(environment, policy="baseline", world=1, config=config)
    picture = np.asarray(panorama_at(trial, trial.decisions[0]))
    print(f"{picture.shape[0]} x {picture.shape[1]} pixels, grey levels {picture.min()} to {picture.max()}")


if __name__ == "__main__":
    main()
