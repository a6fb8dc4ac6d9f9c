"""Faults of what is found again when a command is given once more: estimators, tables of trainings, stores."""

from eval.mutants.mutant import Mutant

PART = "resumption"

_TIMES = "tests/test_recipe_times.py"
_RECIPES = "tests/test_recipes.py"
_ESTIMATORS = "tests/test_estimator.py"
_SWEEPS = "tests/test_sweep.py"

MUTANTS = (
    Mutant(
        PART,
        "a training that was over says another time than before",
        "potlp_jax/learning/training.py",
        "seconds=self._spent",
        "seconds=self.seconds",
        (_RECIPES,),
        "small_recipe",
    ),
    Mutant(
        PART,
        "the time of a checkpoint is finer than what is read of it",
        "potlp_jax/learning/training.py",
        "self._spent = float(np.float32(self.seconds))",
        "self._spent = self.seconds",
        (_RECIPES,),
        "small_recipe",
    ),
    Mutant(
        PART,
        "whole numbers of a training's table come back as others",
        "potlp_jax/recipes/journal.py",
        "return int(text) if text.isdigit() else float(text)",
        "return float(text)",
        (_RECIPES,),
        "small_recipe",
    ),
    Mutant(
        PART,
        "an estimator's file that was written anew is not read anew",
        "potlp_jax/learning/estimator.py",
        "None if state is None else (state.st_mtime_ns, state.st_size, state.st_ino)",
        "None",
        (_ESTIMATORS,),
        "written_again",
    ),
    Mutant(
        PART,
        "reading makes a store where there is none",
        "potlp_jax/sweep/store.py",
        "if not self.file.exists():",
        "if False:",
        (_SWEEPS,),
        "reading_makes_no_store",
    ),
    Mutant(
        PART,
        "what earlier runs of a recipe spent is forgotten",
        "potlp_jax/recipes/times.py",
        "self._spent.get((stage, step), 0.0)",
        "0.0",
        (_TIMES,),
        "earlier_runs",
    ),
    Mutant(
        PART,
        "a recipe's times are written at the end of a step alone",
        "potlp_jax/recipes/times.py",
        "keeping.start()",
        "over.set(), keeping.start()",
        (_TIMES,),
        "killed",
    ),
    Mutant(
        PART,
        "rows are not compared with their checksums",
        "potlp_jax/sweep/store.py",
        '            self._check(checksum, f"the row of {policy} in world {world}", *stored)\n',
        "            assert checksum\n",
        ("tests/test_sweep.py",),
        "called_damaged",
    ),
    Mutant(
        PART,
        "a file is written over the one before",
        "potlp_jax/files.py",
        'temporary = path.with_name(f"{beginning}.{os.getpid()}{TEMPORARY}")',
        "temporary = path",
        ("tests/test_map_command.py",),
        "leave_those_of_before",
    ),
    Mutant(
        PART,
        "of several runs the most impatient decides",
        "potlp_jax/engine/cluster.py",
        "max((entry.deaths for entry in runs.values()), default=before.deaths)",
        "min((entry.deaths for entry in runs.values()), default=before.deaths)",
        ("tests/test_engine.py",),
        "left_as_it_was",
    ),
)
