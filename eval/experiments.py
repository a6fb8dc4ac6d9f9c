"""The experiments behind docs/results, which ``eval.all`` runs: a command each, and the page that shows its results."""

import dataclasses
import re
from collections.abc import Mapping


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment:
    """One command.

    Attributes:
        page: of docs/results, that shows what the command gives.
        command: as its page has it; ``{out}`` is a folder of its own, ``{all}`` that of all experiments, ``{data}`` the
            folder of others' data, ``{processes}`` how many there may be.
        minutes: on two quick cores, of which another experiment may have had one; 1 for less; None where it was not run
            whole since times are kept.
        one_core: whether it measures times, so that it is kept on one core.
        variables: of the environment.
        needs: a variable that must be there before, of a service that somebody has started; None for none.
    """

    page: str
    command: str
    minutes: int | None = None
    one_core: bool = False
    variables: Mapping[str, str] = dataclasses.field(default_factory=dict)
    needs: str | None = None

    @property
    def needs_data(self) -> bool:
        """Whether it reads maps or plans of others."""
        return "{data}" in self.command or "{data}" in self.variables.values()

    @property
    def reads(self) -> list[str]:
        """The experiments whose folders it reads."""
        return re.findall(r"\{all\}/([\w-]+)", self.command)


_OTHERS = {"POTLP_EXTERNAL_DATA": "{data}"}

_COLLECTED = "potlp collect firefighting --split validation --out {out} --set staying_sets=3 --set worlds_per_shard=20"
_DRIVEN = "--set driver=potlp --set estimator=firefighting --set drives=1 --set first_world=5000"
_DELIVERED = (
    "--set look_every=1 --set staying_sets=3 --set views_per_world=12 --set spacing=[4,40] --set posterior=8 "
    "--set nearest=true --set driver=potlp --set estimator=delivery --set drives=1"
)
_SHIPPED = "potlp_jax/learning/data/"

EXPERIMENTS: dict[str, Experiment] = {
    # First what tells the most and is quoted first.
    "table1": Experiment(
        page="table1",
        command="python -m eval.table1 --out {out} --processes {processes} --report docs/results/table1/test",
        minutes=24,
    ),
    # In little space, for what reads it beside other trials.
    "table1-export": Experiment(
        page="table1",
        command="potlp sweep export {all}/table1 --out {out}/rows.csv",
        minutes=1,
    ),
    "table1-rows": Experiment(
        page="table1",
        command="python -m eval.compact_rows {all}/table1-export/rows.csv docs/results/table1/rows.csv.gz",
        minutes=1,
    ),
    # Its trials are compared with the rows of Table I, world by world.
    "observer": Experiment(
        page="table1",
        command="python -m eval.limit --out {out} --worlds 750 --arms ideal-observer",
        minutes=98,
    ),
    "beside": Experiment(
        page="table1",
        command="python -m eval.limit.beside docs/results/table1/rows.csv.gz {all}/observer "
        "--report docs/results/table1/observer",
    ),
    "limit": Experiment(
        page="limit",
        command="python -m eval.limit --out {out} --worlds 60 --report docs/results/limit",
        minutes=24,
    ),
    "limit-delivery": Experiment(
        page="limit_delivery",
        command="python -m eval.limit --out {out} --environment delivery --worlds 16 --buildings 8 "
        "--report docs/results/limit_delivery",
        minutes=2,
    ),
    "worst": Experiment(
        page="worst",
        command="python -m eval.limit.worst {all}/table1 --out {out} --trials 40 --report docs/results/worst",
        minutes=4,
    ),
    # The estimator on what it meets itself and on what the explorer meets, in buildings that chose nothing.
    "own": Experiment(
        page="estimator",
        command=f"{_COLLECTED} {_DRIVEN} --worlds 40 --set views_per_world=10 --set spacing=[10,120]",
        minutes=1,
    ),
    "explored": Experiment(
        page="estimator",
        command=f"{_COLLECTED} --worlds 60 --set first_world=3100 --set views_per_world=5 --set spacing=[10,120] "
        "--set pursued=2",
        minutes=1,
    ),
    "means": Experiment(
        page="estimator",
        command=f"{_COLLECTED} {_DRIVEN} --worlds 40 --set views_per_world=20 --set spacing=[4,40] --set posterior=16",
        minutes=1,
    ),
    "f-own": Experiment(
        page="estimator",
        command=f"potlp estimator evaluate {_SHIPPED}firefighting.npz {{all}}/own --ablate all --out {{out}}",
        minutes=1,
    ),
    "f-explored": Experiment(
        page="estimator",
        command=f"potlp estimator evaluate {_SHIPPED}firefighting.npz {{all}}/explored --out {{out}}",
        minutes=1,
    ),
    "p-own": Experiment(
        page="estimator",
        command=f"potlp estimator evaluate {_SHIPPED}firefighting-panorama.npz {{all}}/own --out {{out}}",
        minutes=1,
    ),
    "p-explored": Experiment(
        page="estimator",
        command=f"potlp estimator evaluate {_SHIPPED}firefighting-panorama.npz {{all}}/explored --out {{out}}",
        minutes=1,
    ),
    "excess": Experiment(
        page="estimator",
        command="python -m eval.limit.excess firefighting --data {all}/means --report docs/results/estimator/excess",
        minutes=1,
    ),
    "ablations": Experiment(
        page="ablations",
        command="python -m eval.ablations --out {out} --views own={all}/own explored={all}/explored "
        "--processes {processes} --beside docs/results/ablations_first.json --report docs/results/ablations",
        minutes=112,
    ),
    "held-out": Experiment(
        page="estimator",
        command="python -m eval.held_out docs/results/table1/rows.csv.gz --out {out} --processes {processes} "
        "--report docs/results/estimator/held_out",
        minutes=5,
    ),
    "panorama": Experiment(
        page="panorama",
        command="python -m eval.table1 --estimator firefighting-panorama --out {out} --processes {processes} "
        "--report docs/results/panorama/test",
        minutes=32,
    ),
    "panorama-export": Experiment(
        page="panorama",
        command="potlp sweep export {all}/panorama --out {out}/rows.csv",
        minutes=1,
    ),
    "panorama-rows": Experiment(
        page="panorama",
        command="python -m eval.compact_rows {all}/panorama-export/rows.csv docs/results/panorama/rows.csv.gz",
        minutes=1,
    ),
    "held-out-panorama": Experiment(
        page="panorama",
        command="python -m eval.held_out docs/results/panorama/rows.csv.gz --estimator firefighting-panorama "
        "--out {out} --processes {processes} --report docs/results/panorama/held_out",
        minutes=8,
    ),
    # The rows of all families go to one folder.
    "fair": Experiment(
        page="fair_settings",
        command="python -m eval.fair_settings firefighting --policies baseline,potlp --worlds 20 --out {out}",
    ),
    "fair-delivery": Experiment(
        page="fair_settings",
        command="python -m eval.fair_settings delivery --policies baseline,potlp --worlds 20 --out {all}/fair",
    ),
    "fair-parcels": Experiment(
        page="fair_settings",
        command="python -m eval.fair_settings parcels --policies baseline --worlds 20 --out {all}/fair",
    ),
    "fair-small": Experiment(
        page="fair_settings",
        command="python -m eval.fair_settings campus-small-parcels --policies baseline --worlds 20 --out {all}/fair",
    ),
    "fair-medium": Experiment(
        page="fair_settings",
        command="python -m eval.fair_settings campus-medium-parcels --policies baseline --worlds 20 --out {all}/fair",
    ),
    "fair-settings": Experiment(
        page="fair_settings",
        command="python -m eval.fair_settings --out {all}/fair --report docs/results/fair_settings",
    ),
    "calibration": Experiment(page="calibration", command="python -m eval.calibrate_firefighting --worlds 100"),
    "delivery": Experiment(
        page="delivery",
        command="python -m eval.delivery --out {out} --plans {data}/floorplans --worlds 1000 --plan-worlds 80 "
        "--formula-worlds 40 --processes {processes} --report docs/results/delivery/first1000",
        minutes=80,
    ),
    "own-delivery": Experiment(
        page="delivery",
        command="potlp collect delivery --split validation --worlds 40 --out {out} --set first_world=1600 "
        + _DELIVERED,
        minutes=2,
    ),
    "own-office": Experiment(
        page="delivery",
        command="potlp collect floorplan:{data}/floorplans/office --split test --worlds 16 --out {out} " + _DELIVERED,
    ),
    "own-school": Experiment(
        page="delivery",
        command="potlp collect floorplan:{data}/floorplans/school --split test --worlds 16 --out {out} " + _DELIVERED,
    ),
    "d-own": Experiment(
        page="delivery",
        command="potlp estimator evaluate delivery {all}/own-delivery --ablate all --out {out}",
        minutes=2,
    ),
    "d-office": Experiment(page="delivery", command="potlp estimator evaluate delivery {all}/own-office --out {out}"),
    "d-school": Experiment(page="delivery", command="potlp estimator evaluate delivery {all}/own-school --out {out}"),
    "worst-delivery": Experiment(
        page="delivery",
        command="python -m eval.limit.worst {all}/delivery/generated --out {out} --trials 10 --buildings 8 "
        "--report docs/results/delivery/worst",
        minutes=3,
    ),
    "worst-office": Experiment(
        page="delivery",
        command="python -m eval.limit.worst {all}/delivery/office --out {out} --trials 10 --buildings 8 "
        "--report docs/results/delivery/worst_office",
        minutes=5,
    ),
    "worst-school": Experiment(
        page="delivery",
        command="python -m eval.limit.worst {all}/delivery/school --out {out} --trials 10 --buildings 8 "
        "--report docs/results/delivery/worst_school",
        minutes=13,
    ),
    "real-maps": Experiment(
        page="delivery",
        command="python -m eval.real_maps --out {out} --maps {data}/maps --worlds 50 --processes {processes} "
        "--report {out}/maps",
        minutes=50,
    ),
    "worst-floor2": Experiment(
        page="delivery",
        command="python -m eval.limit.worst {all}/real-maps/gdc_floor2 --out {out} --trials 10 "
        "--report docs/results/real_maps/floor2_worst",
        minutes=10,
    ),
    "worst-gdc": Experiment(
        page="delivery",
        command="python -m eval.limit.worst {all}/real-maps/gdc_3ne --out {out} --trials 10 "
        "--report docs/results/real_maps/gdc_worst",
        minutes=1,
    ),
    "worst-uma": Experiment(
        page="delivery",
        command="python -m eval.limit.worst {all}/real-maps/uma_rooms --out {out} --trials 10 "
        "--report docs/results/real_maps/uma_worst",
        minutes=1,
    ),
    "worst-intel": Experiment(
        page="delivery",
        command="python -m eval.limit.worst {all}/real-maps/intel_lab --out {out} --trials 10 "
        "--report docs/results/real_maps/intel_worst",
        minutes=16,
    ),
    "campus": Experiment(
        page="delivery",
        command="python -m eval.campus --out {out} --processes {processes} --report docs/results/delivery/campus",
    ),
    # Each shipped recipe from nothing, and what its stages keep: how long one has to train.
    "recipe-firefighting": Experiment(
        page="estimator",
        command="potlp fit --recipe firefighting --out {out} --processes {processes}",
        minutes=130,
    ),
    "curve-firefighting": Experiment(
        page="estimator",
        command="python -m eval.training_curve {all}/recipe-firefighting --environment firefighting --worlds 60 "
        "--out {out} --report docs/results/estimator/curve",
        minutes=10,
    ),
    "recipe-delivery": Experiment(
        page="delivery",
        command="potlp fit --recipe delivery --out {out} --processes {processes}",
        minutes=105,
    ),
    "curve-delivery": Experiment(
        page="delivery",
        command="python -m eval.training_curve {all}/recipe-delivery --environment delivery --worlds 100 --out {out} "
        "--report docs/results/delivery/curve",
        minutes=6,
    ),
    "small-generator": Experiment(
        page="delivery",
        command="python -m eval.small_generator {all}/recipe-delivery --plans {data}/floorplans --out {out} "
        "--processes {processes} --report docs/results/delivery/small_generator",
        minutes=102,
    ),
    "recipe-parcels": Experiment(
        page="delivery",
        command="potlp fit --recipe parcels --out {out} --processes {processes}",
        minutes=45,
    ),
    "curve-parcels": Experiment(
        page="delivery",
        command="python -m eval.training_curve {all}/recipe-parcels --environment campus-small-parcels --worlds 100 "
        "--out {out} --report docs/results/delivery/curve_parcels",
        minutes=4,
    ),
    "floors": Experiment(page="floors", command="python -m eval.floor_statistics", variables=_OTHERS, minutes=1),
    "buildings": Experiment(
        page="buildings",
        command="python -m eval.buildings --data {data} --out {out}/rows.jsonl --most 6 "
        "--report docs/results/buildings",
        minutes=54,
    ),
    "commits": Experiment(
        page="commits",
        command="python -m eval.commits --pairs 10000 --out {out}/rows.jsonl --report docs/results/commits.json",
        minutes=10,
    ),
    "trials": Experiment(
        page="trials",
        command="python -m eval.trials firefighting rooms maps revealed --processes {processes} --out {out}",
        variables=_OTHERS,
        minutes=25,
    ),
    "live": Experiment(
        page="live",
        command="python -m eval.live --streams 1000 --out docs/results/live.json",
        variables=_OTHERS,
        minutes=2,
    ),
    "live-recorded": Experiment(
        page="live",
        command="python -m eval.live.recorded --out {out} --maps {data}/maps --report docs/results/live/recorded",
        minutes=12,
    ),
    "faults-files": Experiment(
        page="faults",
        command="python -m eval.faults files --cases 5000 --out {out}",
        minutes=6,
    ),
    "faults-texts": Experiment(page="faults", command="python -m eval.faults texts --cases 100000 --out {out}"),
    "faults-formulas": Experiment(
        page="faults",
        command="python -m eval.faults formulas --cases 1000 --out {out}",
        minutes=17,
    ),
    "faults-kills": Experiment(page="faults", command="python -m eval.faults kills --cases 300 --out {out}"),
    "scale-overhead": Experiment(
        page="scale",
        command="python -m eval.scale overhead --out {out} --report docs/results/scale/overhead",
        minutes=1,
    ),
    "scale-store": Experiment(
        page="scale",
        command="python -m eval.scale store --out {out} --report docs/results/scale/store",
        minutes=1,
    ),
    "scale-kills": Experiment(
        page="scale",
        command="python -m eval.scale kills --out {out} --report docs/results/scale/kills",
        minutes=8,
    ),
    "scale-fits": Experiment(
        page="scale", command="python -m eval.scale fits --out {out} --report docs/results/scale/fits"
    ),
    "scale-slurm": Experiment(
        page="scale",
        command="python -m eval.scale slurm --jobs-killed 5 --out {out} --report docs/results/scale/slurm",
        needs="SLURM_CONF",
    ),
    "collected": Experiment(
        page="scale",
        command="potlp collect firefighting --split training --worlds 10000 --out {out} --processes {processes} "
        "--set first_world=60000 --set spacing=[0,8] --set look_every=0 --set staying_sets=3 --set pursued=1 "
        "--set worlds_per_shard=50 --set views_per_world=4",
        minutes=13,
    ),
    "scale-reading": Experiment(
        page="scale",
        command="python -m eval.scale reading --data {all}/collected --validation {all}/means --out {out} "
        "--report docs/results/scale/reading",
        minutes=6,
    ),
    "mutants": Experiment(page="mutants", command="python -m eval.mutants --report docs/results/mutants"),
    # Those that measure times come last: nothing else of this list runs beside them.
    "release": Experiment(
        page="release", command="python -m eval.release --out {out} --report docs/results/release", one_core=True
    ),
    "decision": Experiment(
        page="speed",
        command="python -m eval.bench.decision --worlds 2 --out docs/results/speed/after.json",
        one_core=True,
        minutes=3,
    ),
    "decision-twins": Experiment(
        page="speed",
        command="python -m eval.bench.decision --worlds 2 --out docs/results/speed/before.json",
        one_core=True,
        variables={"POTLP_NATIVE": "0"},
        minutes=6,
    ),
    "decision-estimators": Experiment(
        page="speed",
        command="python -m eval.bench.decision --worlds 2 --policies potlp --estimators firefighting-panorama "
        "firefighting --out docs/results/speed/estimators.json",
        one_core=True,
        minutes=1,
    ),
    "distances": Experiment(
        page="planner",
        command="python -m eval.bench.distances --repeats 3 --out docs/results/planner/distances.json "
        "--plot docs/results/planner/distances.png",
        one_core=True,
        minutes=1,
    ),
    "native": Experiment(page="planner", command="python -m eval.bench.native", one_core=True, minutes=7),
    "ended": Experiment(
        page="planner",
        command="python -m eval.bench.ended --instances 60 --simulations 500 --seconds 2 --out {out}",
        minutes=1,
    ),
    "regret": Experiment(
        page="planner",
        command="python -m eval.bench.regret --planners best-first po-uct-numba po-uct-pomdp-py --subgoals 2 4 6 8 12 "
        "--instances 8 --seconds 2 --budgets 30 300 1000 10000 100000 --out {out}",
        one_core=True,
    ),
    "rates": Experiment(
        page="planner",
        command="python -m eval.bench.regret --planners best-first po-uct po-uct-numba po-uct-pomdp-py mctx --families "
        "find firefighting two three-single --subgoals 8 --instances 8 --seconds 2 --budgets 30 300 1000 --out {out}",
        one_core=True,
        minutes=7,
    ),
    "optimism": Experiment(
        page="planner",
        command="python -m eval.bench.regret --split tuning --planners best-first --optimism .3 .4 .6 .7 1 "
        "--subgoals 4 8 --instances 8 --seconds 2 --budgets 30 300 1000 10000 --families find three-single "
        "three-joint two firefighting reuse random cubes shared rare extreme cheap dear clustered four --out {out}",
        one_core=True,
        minutes=17,
    ),
    "throughput": Experiment(
        page="planner",
        command="python -m eval.bench.throughput --batches 1 64 --simulations 300 --repeats 3 --out {out}",
        one_core=True,
        minutes=1,
    ),
}
"""By the name that ``--only`` takes, in the order in which they run."""
