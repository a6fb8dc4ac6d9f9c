"""A step of a fit with the processor as one device, and as several that share each batch.

    python -m eval.bench.fit_devices --data DATASET

Every number of devices needs a process of its own. Seconds a step are the least of the repeats, each of ten steps with
their share of decoding, compilation apart. Devices that share few cores may wait for each other for ever, so that a
process that does not end is ended and named.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

from potlp_jax.cache import enable_compilation_cache
from potlp_jax.learning.building_learner import BuildingOptions
from potlp_jax.learning.dataset_reading import read_dataset
from potlp_jax.learning.panorama_learner import PanoramaOptions
from potlp_jax.learning.training import seconds_per_step
from potlp_jax.learning.training_options import TrainingConfig

NETWORKS: dict[str, BuildingOptions | PanoramaOptions] = {"building": BuildingOptions(), "panorama": PanoramaOptions()}
LONGEST = 300.0
"""Seconds after which a process is taken to hang."""


def measure(data: Path, network: str, repeats: int) -> float:
    """Seconds a step in this process, with the devices that it has."""
    samples = read_dataset(data)
    learner, config = NETWORKS[network].learner(samples), TrainingConfig(steps=1)
    return min(seconds_per_step(learner, samples, config, steps=10) for _ in range(repeats))


def measured_elsewhere(data: Path, network: str, devices: int, repeats: int) -> str:
    """The same in a process of its own, in words."""
    words = [sys.executable, "-m", "eval.bench.fit_devices", "--data", str(data), "--network", network]
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}".strip()
    try:
        done = subprocess.run(
            [*words, "--repeats", str(repeats)],
            env={**os.environ, "XLA_FLAGS": flags},
            capture_output=True,
            text=True,
            timeout=LONGEST,
        )
    except subprocess.TimeoutExpired:
        return f"had not ended after {LONGEST:.0f} s"
    if done.returncode:
        return "ended: " + ("devices waited for each other" if "Termination timeout" in done.stderr else done.stderr)
    return f"{float(done.stdout):.3f} s a step"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="what `potlp collect firefighting` wrote")
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--network", choices=NETWORKS, help="measure this one, in this process")
    arguments = parser.parse_args()
    enable_compilation_cache()
    if arguments.network:
        print(measure(arguments.data, arguments.network, arguments.repeats))
        return
    for network in NETWORKS:
        for devices in arguments.devices:
            told = measured_elsewhere(arguments.data, network, devices, arguments.repeats)
            print(f"{network}, {devices} devices: {told}", flush=True)


if __name__ == "__main__":
    main()
