"""The planner as files: programs of plain arrays that run with jax alone, without this package.

``export_planner`` writes a folder:

* ``plan.jaxexport``: the search on a bare planning problem, for callers with maps and distances of their own;
* ``subgoals.jaxexport`` and ``decide.jaxexport``: the whole decision on a grid of fixed size, cut where the estimator
  comes in (``planning.decision``);
* ``task.hoa``: the automaton; the programs hold the task's arrays as constants;
* ``manifest.json``: names, shapes, types and meanings of every input and output, in order, the task, the
  configuration, and what sentinels and status bits mean.

A program is called with its inputs by position and returns a tuple:

    manifest = json.loads((folder / "manifest.json").read_text())
    plan = jax.export.deserialize((folder / manifest["functions"]["plan"]["file"]).read_bytes())
    outputs = plan.call(*inputs)
"""

import dataclasses
import datetime
import hashlib
import importlib.metadata
import importlib.util
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.export
from jaxtyping import Array, UInt32

from potlp_jax.errors import ExportError
from potlp_jax.files import MIB, MOST_TEXT, one_line, read_bytes, read_json, reading, short
from potlp_jax.native import twin_only
from potlp_jax.planning.decision import decide_from_estimates, frontier_subgoals, subgoals_at
from potlp_jax.planning.estimates import Estimates
from potlp_jax.planning.move import Move, MoveKind
from potlp_jax.planning.problem import PlanningProblem
from potlp_jax.planning.search.api import plan_actions
from potlp_jax.planning.search.config import BestFirstConfig, UctConfig
from potlp_jax.planning.situation import DecisionConfig
from potlp_jax.precision import in_32_bits
from potlp_jax.task.propositions import check_propositions, in_order, require_same_propositions
from potlp_jax.task.task import Task
from potlp_jax.types import NO_ACTION, NO_STATE, NO_SUBGOAL, Status
from potlp_jax.world.grid import BeliefMap

FORMAT: int = 2
"""Version of the folder's layout."""

PROGRAMS: tuple[str, ...] = ("plan", "subgoals", "decide")
"""Names of the programs that an export may have."""

MANIFEST: str = "manifest.json"
PLATFORMS: tuple[str, ...] = ("cpu", "cuda")
ANY_BATCH: str = "any"
_BATCH_DIMENSION = "b"

_MOST_PROGRAM = 1024 * MIB
"""Bytes of a program; those of a large map have some 10 MiB."""

# Named, because a caller without this package has to make the same kind of key from two words.
_KEY_IMPLEMENTATION = "threefry2x32"

_SEARCH_NAMES = {
    "best-first": "Best-first search on bounds (deterministic, of the family of AO*)",
    "uct": "PO-UCT (sampled, the search of Bradley et al. 2021)",
}


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """What to export.

    Attributes:
      grid: rows and columns of the map; None exports the search alone.
      subgoals: S, length of the array of subgoals.
      decision: settings of the search and of the decision; ``subgoals`` replaces its ``frontiers.max_subgoals``.
      batch: None for programs of one problem; a number for a leading axis of that length on every input and output;
        ``ANY_BATCH`` for a leading axis of any length, the same for all inputs of a call.
      platforms: what the programs are lowered for, of jax's names ``cpu``, ``cuda``, ``rocm``, ``tpu``.
    """

    grid: tuple[int, int] | None = None
    subgoals: int = 12
    decision: DecisionConfig = DecisionConfig()
    batch: int | str | None = None
    platforms: tuple[str, ...] = PLATFORMS

    def __post_init__(self) -> None:
        if self.subgoals < 1:
            raise ValueError(f"ExportConfig.subgoals is {self.subgoals}, must be at least 1")
        if self.grid is not None and min(self.grid) < 1:
            raise ValueError(f"ExportConfig.grid is {self.grid}, rows and columns must be at least 1")
        if self.batch != ANY_BATCH and self.batch is not None and (isinstance(self.batch, str) or self.batch < 1):
            raise ValueError(f"ExportConfig.batch is {self.batch!r}, must be None, at least 1, or {ANY_BATCH!r}")
        if not self.platforms:
            raise ValueError("ExportConfig.platforms is empty, name at least one platform")

    @property
    def settings(self) -> DecisionConfig:
        """``decision`` with as many subgoals as the arrays hold."""
        frontiers = dataclasses.replace(self.decision.frontiers, max_subgoals=self.subgoals)
        return dataclasses.replace(self.decision, frontiers=frontiers)


@dataclasses.dataclass(frozen=True)
class _Value:
    """An input or output of a program, without the batch axis."""

    name: str
    shape: tuple[int, ...]
    dtype: str
    meaning: str


@dataclasses.dataclass(frozen=True)
class _Program:
    """A function of plain arrays by position, to a tuple of plain arrays."""

    name: str
    meaning: str
    function: Callable[..., tuple[Array, ...]]
    inputs: tuple[_Value, ...]
    outputs: dict[str, str]
    """Names and meanings, in order."""


def export_planner(task: Task, folder: Path, config: ExportConfig = ExportConfig()) -> list[Path]:
    """Write the planner for one task into a folder.

    Lowering for a platform needs neither that platform nor its libraries.

    Args:
      task: its arrays become constants of the programs.
      folder: made if it is not there; files of the same names are replaced.
      config: what to export.

    Returns:
      The files: programs, automaton and manifest.

    Raises:
      ModuleNotFoundError: flatbuffers is not installed; jax writes and reads programs with it.
    """
    # jax imports it when it serialises, after minutes of lowering: better asked for at once.
    if importlib.util.find_spec("flatbuffers") is None:
        raise ModuleNotFoundError(
            "exporting needs flatbuffers, with which jax writes programs: pip install flatbuffers"
        )
    folder.mkdir(parents=True, exist_ok=True)
    programs = _programs(task, config)
    files, functions = [], {}
    for program in programs:
        exported = export_program(program, config)
        file, contents = folder / f"{program.name}.jaxexport", exported.serialize()
        file.write_bytes(contents)
        files.append(file)
        described = _describe_program(program, exported, file.name)
        functions[program.name] = {**described, "sha256": hashlib.sha256(contents).hexdigest()}
    # Programs of an earlier export: the manifest of this one does not name them. Other files are somebody's own.
    for name in PROGRAMS:
        if (earlier := folder / f"{name}.jaxexport") not in files:
            earlier.unlink(missing_ok=True)
    automaton = folder / "task.hoa"
    automaton.write_text(task.to_hoa(), "utf-8")
    manifest = folder / MANIFEST
    manifest.write_text(json.dumps(_manifest(task, config, functions), indent=2, allow_nan=False) + "\n", "utf-8")
    return [*files, automaton, manifest]


def export_program(program: _Program, config: ExportConfig) -> jax.export.Exported:
    """Lower one program for the configuration's platforms and batch."""
    # Shapes alone: nothing is computed or allocated.
    lead = batch_shape(config.batch)
    function = program.function if config.batch is None else jax.vmap(program.function)
    arguments = [jax.ShapeDtypeStruct((*lead, *value.shape), value.dtype) for value in program.inputs]
    # Native kernels are no part of a program that needs jax alone.
    with twin_only():
        return jax.export.export(jax.jit(function), platforms=config.platforms)(*arguments)


def batch_shape(batch: int | str | None) -> tuple[Any, ...]:
    """The leading axes of every array; a dimension variable for any length."""
    if batch is None:
        return ()
    return tuple(jax.export.symbolic_shape(_BATCH_DIMENSION)) if batch == ANY_BATCH else (batch,)


def load_program(folder: Path | str, name: str, propositions: Sequence[str]) -> Callable[..., dict[str, Array]]:
    """A program of an exported folder as a function from named inputs to named outputs.

    For use where this package is installed; elsewhere the module's docstring shows the lines that it takes.

    Args:
      folder: written by ``export_planner``.
      name: of the program.
      propositions: names of the bits of the letters that it will be given, in order, such as ``World.propositions``.

    Returns:
      The function. Its inputs are plain arrays, so that nothing can be checked of their meaning any more.

    Raises:
      PropositionsError: the program was exported for a task over other propositions.
      ExportError: the folder is of another format or holds no such program, a file of it is missing or damaged, or a
        call does not name exactly the program's inputs.
    """
    folder = Path(folder)
    manifest = read_json(folder / MANIFEST, ExportError, "a manifest", MOST_TEXT)
    found = manifest.get("format") if isinstance(manifest, dict) else None
    if found != FORMAT:
        raise ExportError(
            f"{folder}: format {short(found)} of exported planners; this version reads {FORMAT}: export it again"
        )
    with reading(folder / MANIFEST, ExportError, "a manifest"):
        require_same_propositions(
            check_propositions(manifest["task"]["propositions"]),
            propositions,
            asker=f"the planner in {folder}",
            knower="what is to call it",
            remedy="write the letters in the former's order, or export the task over the latter",
        )
        functions = manifest["functions"]
        if name not in functions:
            raise ExportError(f"{folder} holds no program {name!r}; it has: {one_line(', '.join(functions))}")
        entry = functions[name]
        file, digest = folder / Path(entry["file"]).name, entry["sha256"]
        wanted = {value["name"]: f"{value['dtype']}{value['shape']}" for value in entry["inputs"]}
        results = [value["name"] for value in entry["outputs"]]
    program = _load(file, digest)

    @in_32_bits
    def call(**inputs: Any) -> dict[str, Array]:
        if set(inputs) != set(wanted):
            raise ExportError(f"{name} takes exactly {', '.join(wanted)}; found {', '.join(inputs)}")
        try:
            return dict(zip(results, program.call(*[inputs[each] for each in wanted]), strict=True))
        except (TypeError, ValueError) as error:
            takes = ", ".join(f"{each}: {kind}" for each, kind in wanted.items())
            raise ExportError(f"{name} takes arrays of these types and shapes: {takes}; {one_line(error)}") from error

    return call


def _load(file: Path, digest: str) -> jax.export.Exported:
    contents = read_bytes(file, ExportError, _MOST_PROGRAM)
    # Before jax sees it: a damaged program can end the process within the compiler, where nothing catches it.
    if hashlib.sha256(contents).hexdigest() != digest:
        raise ExportError(f"{file}: is not the program that the manifest names, or is damaged: export it again")
    with reading(file, ExportError, "an exported program of this version of jax"):
        # `deserialize` is annotated for a bytearray.
        return jax.export.deserialize(bytearray(contents))


def _programs(task: Task, config: ExportConfig) -> list[_Program]:
    search = _plan_program(task, config.subgoals, config.decision.search)
    if config.grid is None:
        return [search]
    return [search, _subgoals_program(task, config.grid, config), _decide_program(task, config.grid, config)]


def _plan_program(task: Task, subgoals: int, search: BestFirstConfig | UctConfig) -> _Program:
    arrays, states, classes = task.arrays, task.sizes.states, task.sizes.classes
    # The task's arrays are concrete here, and constants of the program. The names are those of `PlanningProblem`, so
    # that inputs by position become fields by name.
    names = ("travel", "finish", "success_probability", "success_cost", "failure_cost")
    names = (*names, "dfa_state", "subgoal_mask", "dead_end_cost")

    def plan(*inputs: Array) -> tuple[Array, ...]:
        fields, key = inputs[: len(names)], inputs[len(names) :]
        problem = PlanningProblem.from_arrays(arrays, **dict(zip(names, fields, strict=True)))
        found = plan_actions(problem, _key(key), search)
        return tuple(getattr(found, name) for name in _PLAN_OUTPUTS)

    return _Program(
        name="plan",
        meaning=f"{_SEARCH_NAMES[search.kind]} on a planning problem: the high-level action of least expected cost",
        function=plan,
        inputs=(
            _Value(
                "travel",
                (subgoals + 1, states, subgoals, states),
                "float32",
                "[u, z, s, z']: path cost through known space from node u in state z to subgoal s in state z', inf "
                "where there is no path; nodes 0 .. S-1 are the subgoals, S is the robot. From a subgoal the path "
                "starts by re-entering the subgoal's cell",
            ),
            _Value(
                "finish",
                (subgoals + 1, states),
                "float32",
                "[u, z]: path cost through known space to acceptance, inf where there is no path",
            ),
            *_estimate_inputs(subgoals, classes),
            _Value("dfa_state", (), "int32", "the automaton's state, the letter of the robot's cell read"),
            _Value("subgoal_mask", (subgoals,), "bool", "True where a subgoal is real, False on padding"),
            _Value(
                "dead_end_cost",
                (),
                "float32",
                "cost of a history in which no action is available and the task is not satisfied, positive",
            ),
            *_key_inputs(search),
        ),
        outputs=_PLAN_OUTPUTS,
    )


def _subgoals_program(task: Task, grid: tuple[int, int], config: ExportConfig) -> _Program:
    arrays, settings = task.arrays, config.settings

    def subgoals(*inputs: Array) -> tuple[Array, ...]:
        # `Subgoals` calls them `cells` and `mask`; `decide` has an input `cells` already, the map's.
        found = frontier_subgoals(*_belief_and_robot(inputs, task), arrays, settings)
        return tuple(getattr(found, name.removeprefix("subgoal_")) for name in _SUBGOAL_OUTPUTS)

    return _Program(
        name="subgoals",
        meaning="Frontiers of known space and their subgoals: where estimates are wanted",
        function=subgoals,
        inputs=_map_inputs(grid, task),
        outputs=_SUBGOAL_OUTPUTS,
    )


def _decide_program(task: Task, grid: tuple[int, int], config: ExportConfig) -> _Program:
    arrays, settings = task.arrays, config.settings
    # Three groups of inputs, in this order: the map and the robot, the subgoals and their estimates, the key.
    map_inputs = _map_inputs(grid, task)

    def decide(*inputs: Array) -> tuple[Array, ...]:
        belief, cell, state = _belief_and_robot(inputs[: len(map_inputs)], task)
        cells, mask, probability, success_cost, failure_cost, *key = inputs[len(map_inputs) :]
        estimates = Estimates(success_probability=probability, success_cost=success_cost, failure_cost=failure_cost)
        subgoals = subgoals_at(cells, mask, *grid)
        move = decide_from_estimates(belief, subgoals, estimates, arrays, cell, state, _key(key), settings)
        return _move_outputs(move)

    return _Program(
        name="decide",
        meaning="The whole decision: travel costs through known space, search, choice, path to its target",
        function=decide,
        inputs=(
            *map_inputs,
            _Value(
                "subgoal_cells",
                (config.subgoals, 2),
                "int32",
                "row and column of each subgoal, an observed free cell: from `subgoals`, or your own",
            ),
            _Value("subgoal_mask", (config.subgoals,), "bool", "True where a subgoal is real, False on padding"),
            *_estimate_inputs(config.subgoals, task.sizes.classes),
            *_key_inputs(settings.search),
        ),
        outputs=_MOVE_OUTPUTS,
    )


def _belief_and_robot(inputs: Sequence[Array], task: Task) -> tuple[BeliefMap, Array, Array]:
    cells, letters, resolution, extent, cell, state = inputs
    # Plain arrays have no names. Whoever loads the program states them instead (``load_program``).
    belief = BeliefMap(
        cells=cells, letters=letters, resolution=resolution, extent=extent, propositions=task.propositions
    )
    return belief, cell, state


def _key(words: Sequence[UInt32[Array, "2"]]) -> Array:
    """The key of an optional input; any key where the program has no such input, because its search draws nothing."""
    return jax.random.wrap_key_data(words[0], impl=_KEY_IMPLEMENTATION) if words else jax.random.key(0)


def _move_outputs(move: Move) -> tuple[Array, ...]:
    # `decide_from_estimates` always searches; for type checkers.
    assert move.search is not None
    plan = move.search.plan
    values = {
        "kind": move.kind,
        "target_cell": move.target_cell,
        "target_state": move.target_state,
        "action": plan.action,
        "subgoal": plan.subgoal,
        "from_state": plan.from_state,
        "to_state": plan.to_state,
        "value": move.value,
        "q_values": plan.q_values,
        "path_cells": move.path.cells,
        "path_states": move.path.states,
        "path_length": move.path.length,
        "path_cost": move.path.cost,
        "status": move.status,
    }
    return tuple(values[name] for name in _MOVE_OUTPUTS)


def _map_inputs(grid: tuple[int, int], task: Task) -> tuple[_Value, ...]:
    return (
        _Value(
            "cells",
            grid,
            "int8",
            f"{BeliefMap.UNKNOWN} not observed, {BeliefMap.FREE} free, {BeliefMap.OCCUPIED} occupied; row 0 on top",
        ),
        _Value(
            "letters",
            grid,
            "int32",
            f"bit i: proposition i of {in_order(task.propositions)} is true in the cell; 0 where it is not observed",
        ),
        _Value("resolution", (), "float32", "length of a cell's side in the unit of cost"),
        _Value("extent", (2,), "int32", "rows and columns of the map without padding"),
        _Value("cell", (2,), "int32", "the robot's row and column"),
        _Value("state", (), "int32", "the automaton's state, the letter of the robot's cell read"),
    )


def _estimate_inputs(subgoals: int, classes: int) -> tuple[_Value, ...]:
    shape = (subgoals, classes)
    return (
        _Value("success_probability", shape, "float32", "P_S of each subgoal and outcome class, in [0, 1]"),
        _Value("success_cost", shape, "float32", "R_S, positive and finite, also where P_S is 0"),
        _Value("failure_cost", shape, "float32", "R_F, finite, not negative"),
    )


def _key_inputs(search: BestFirstConfig | UctConfig) -> tuple[_Value, ...]:
    # Best-first search is deterministic: an input that changes nothing would only mislead.
    if isinstance(search, BestFirstConfig):
        return ()
    return (_Value("key", (2,), "uint32", "two random words: jax.random.key_data of a threefry2x32 key"),)


_PLAN_OUTPUTS = {
    "action": "s * E + e for edge e at subgoal s, S * E for finish, or NO_ACTION",
    "subgoal": "the action's subgoal, NO_SUBGOAL for finish and for none",
    "from_state": "state z' in which to reach the subgoal, NO_STATE for finish and for none",
    "to_state": "state z'' to try for beyond it, NO_STATE for finish and for none",
    "value": "expected cost to go",
    "q_values": "expected cost of each action, inf where it is not available",
    "visits": "simulations that began with each action",
    "optimism_gap": "fraction by which value would fall if its guesses were too high by the optimism, no bound on the "
    "error; 0: the optimum is no higher than value",
    "lower_bound": "the optimum is no lower; equal to value: value is the optimum, more simulations change nothing",
    "status": "bits, see status_bits",
}

_SUBGOAL_OUTPUTS = {
    "subgoal_cells": "row and column of each subgoal, nearest first; (0, 0) where masked",
    "subgoal_mask": "True on real subgoals; they come first",
    "size": "cells of the subgoal's frontier; 0 where masked",
    "distance": "path cost to the subgoal in any state; inf where masked",
    "component": "subgoal whose frontier the cell belongs to, NO_SUBGOAL elsewhere",
    "frontier": "True on every cell of the frontier",
    "status": "bits, see status_bits",
}

_MOVE_OUTPUTS = {
    "kind": "what the move is for, see move_kinds",
    "target_cell": "row and column where the path leads; the robot's own where there is no move",
    "target_state": "the automaton's state on arrival",
    **{name: _PLAN_OUTPUTS[name] for name in ("action", "subgoal", "from_state", "to_state", "value", "q_values")},
    "path_cells": "entries 0 .. path_length are the cells of the path, the robot's first; later ones repeat the last",
    "path_states": "the automaton's states along the path",
    "path_length": "moves in the path as it is handed out",
    "path_cost": "cost of the whole path to its target, inf where it is out of reach",
    "status": "bits, see status_bits",
}


def _describe_program(program: _Program, exported: jax.export.Exported, file: str) -> dict[str, Any]:
    # Shapes and types as jax lowered them, not as they were asked for: what a caller has to give.
    inputs = [
        {"name": value.name, "shape": _shape(aval.shape), "dtype": str(aval.dtype), "meaning": value.meaning}
        for value, aval in zip(program.inputs, exported.in_avals, strict=True)
    ]
    outputs = [
        {"name": name, "shape": _shape(aval.shape), "dtype": str(aval.dtype), "meaning": meaning}
        for (name, meaning), aval in zip(program.outputs.items(), exported.out_avals, strict=True)
    ]
    return {
        "file": file,
        "meaning": program.meaning,
        "inputs": inputs,
        "outputs": outputs,
        "platforms": list(exported.platforms),
        "calling_convention_version": exported.calling_convention_version,
    }


def _shape(shape: Sequence[Any]) -> list[int | str]:
    """Sizes as numbers, a dimension of any length by its name."""
    return [size if isinstance(size, int) else str(size) for size in shape]


def _manifest(task: Task, config: ExportConfig, functions: dict[str, Any]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "created": datetime.date.today().isoformat(),
        "potlp_jax": importlib.metadata.version("potlp-jax"),
        "jax": jax.__version__,
        "task": {**task.describe(), "hoa": task.to_hoa()},
        "config": {
            "grid": None if config.grid is None else list(config.grid),
            "subgoals": config.subgoals,
            "batch": config.batch,
            "decision": dataclasses.asdict(config.settings),
        },
        "sentinels": {"NO_ACTION": NO_ACTION, "NO_STATE": NO_STATE, "NO_SUBGOAL": NO_SUBGOAL},
        # Read off the classes, so that the manifest cannot fall behind them.
        "move_kinds": {name: value for name, value in vars(MoveKind).items() if name.isupper()},
        "status_bits": {str(bit.name): int(bit) for bit in Status},
        "functions": functions,
    }
