"""Writes the golden file of canonical covers for the four fire-fighting tasks, from the slow reference.

python -m tests.reference.make_golden_covers
"""

import json
from pathlib import Path

from potlp_jax.task.task import Task
from tests.reference.covers import canonical_cover

GOLDEN_COVERS = Path(__file__).parent / "golden_covers.json"


def golden_covers() -> dict[str, dict[str, list[list[int]]]]:
    """Per task and per transition ``"z->z'"`` the cover's phi vectors (fire, alarm, extinguisher, exit)."""
    golden = {}
    for number in range(1, 5):
        name = f"firefighting-{number}"
        table = Task.shipped(name).dfa.transitions.tolist()
        golden[name] = {
            f"{source}->{target}": [
                list(phi) for phi in canonical_cover(frozenset(i for i, state in enumerate(row) if state == target), 4)
            ]
            for source, row in enumerate(table)
            for target in sorted(set(row))
        }
    return golden


if __name__ == "__main__":
    GOLDEN_COVERS.write_text(json.dumps(golden_covers(), indent=1) + "\n")
