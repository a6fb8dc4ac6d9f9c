"""Run a trial, look at it, and run the same task with another policy."""

import potlp_jax


def main() -> None:
    """Compare PO-TLP's rule with perfect estimates to the baseline in one world."""
    environment = potlp_jax.make("toy")
    task = environment.task("!hazard U goal")
    for policy in ("baseline", "oracle"):
        trial = potlp_jax.run(environment, task, policy, world=3)
        print(f"{policy}: {trial.outcome}, cost {trial.cost:.1f}, {len(trial.decisions)} decisions")


if __name__ == "__main__":
    main()
