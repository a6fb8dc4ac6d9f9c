"""``potlp estimator``: what an estimator is, and how good it is."""

import dataclasses
import importlib.util
import math
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.cli.output import FAILED, console, fail, print_json
from potlp_jax.codec import finite_or_null
from potlp_jax.errors import CheckpointError
from potlp_jax.learning.fovea import ABOVE, BAND, BELOW
from potlp_jax.learning.network import operation_counts, parameter_count
from potlp_jax.learning.serialization import load_estimator


def show_estimator(path: Path, json: bool) -> None:
    """Print what an estimator file says of itself."""
    try:
        params, config, metadata = load_estimator(path)
    except CheckpointError as error:
        fail(str(error))
    first, second = operation_counts(config)
    description = {
        "estimator": str(path),
        "bytes": path.stat().st_size,
        "parameters": parameter_count(params),
        "operations_per_panorama": first,
        "operations_per_answer": second,
        "network": dataclasses.asdict(config),
        "metadata": metadata,
    }
    if json:
        print_json(finite_or_null(description))
        return
    out = console()
    out.print(str(path), markup=False, style="bold")
    table = Table(box=SIMPLE_HEAD, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column()
    for name, value in _rows(description):
        table.add_row(name, value)
    out.print(table)


def evaluate_estimator(path: Path, dataset: Path, out: Path | None, ablate: str, json: bool) -> None:
    """Report how good an estimator is on a data set."""
    if importlib.util.find_spec("pyarrow") is None:
        fail("data sets are Parquet files, and pyarrow is not installed: pip install 'potlp-jax[train]'", FAILED)
    from potlp_jax.cli.evaluation import run_evaluation

    run_evaluation(path, dataset, out, ablate, json)


def _fovea(reach: int) -> str:
    if not reach:
        return "nothing"
    return f"{2 * reach + 1} columns × {(ABOVE + BELOW) * BAND} rows around each subgoal"


def _rows(description: dict[str, Any]) -> list[tuple[str, str]]:
    """Names and values for people; what the file does not say is left out."""
    network, metadata = description["network"], description["metadata"]
    data = metadata.get("data", {})
    rows = [
        ("propositions", ", ".join(network["propositions"])),
        ("panorama", " × ".join(map(str, network["image_shape"])) + " pixels"),
        ("looked at closely", _fovea(network["fovea"])),
        ("file", f"{description['bytes'] / 1e6:.2f} MB, {description['parameters']:,} parameters"),
        (
            "arithmetic",
            f"{description['operations_per_panorama'] / 1e6:.1f} MFLOP a panorama, "
            f"{description['operations_per_answer'] / 1e6:.1f} MFLOP a subgoal and class",
        ),
        ("convolutions", f"{_list(network['first_widths'])}, then {_list(network['second_widths'])} channels"),
        ("fully connected", f"{_list(network['dense_widths'])} units"),
    ]
    if data:
        rows.append(("trained on", f"{data.get('environment')}/{data.get('split')}, costs in {data.get('unit')}"))
    if "panoramas" in metadata:
        rows.append(("", f"{metadata['panoramas']:,} panoramas, {metadata.get('samples', 0):,} samples"))
    if "steps" in metadata:
        minutes = metadata.get("seconds", 0) / 60
        rows.append(
            (
                "training",
                f"{metadata['steps']:,} steps in {minutes:.0f} minutes, ended by {metadata.get('ended_by')}; "
                f"best at step {metadata.get('best_step'):,}",
            )
        )
    if "prior" in metadata:
        rows.append(("mean P_S of the data", f"{metadata['prior']:.4f}"))
    rows += [
        (name.replace("_", " "), f"{value:.4f}")
        for name, value in metadata.get("figures", {}).items()
        if name.startswith("validation_") and name != "validation_samples" and math.isfinite(value)
    ]
    if "versions" in metadata:
        rows.append(("versions", ", ".join(f"{name} {value}" for name, value in metadata["versions"].items())))
    return rows


def _list(values: list[int]) -> str:
    return ", ".join(map(str, values))
