"""What goes wrong with inputs and files, under one base class: one handler in the command line catches them all.

A message names what is wrong, where, and what to do. Anything that is not a ``PotlpError`` is a fault of the program.
"""

from pathlib import Path

_BEGINNING, _END = 600, 300
"""Characters of a message that are kept at either end: the file and the field stand first, what to do stands last."""


class PotlpError(ValueError):
    """Base of all errors about what was given: a task, a map, a file, a setting."""

    def __init__(self, message: str) -> None:
        # Messages quote what was given, and what was given may be a name of 20,000 characters.
        if len(message) > _BEGINNING + _END:
            message = f"{message[:_BEGINNING]} [...] {message[-_END:]}"
        super().__init__(message)

    @classmethod
    def of_file(cls, file: Path | str, message: str) -> "PotlpError":
        """An error about a file as a whole, whatever else errors of this class are made of."""
        return cls(f"{file}: {message}")


class PotlpWarning(UserWarning):
    """Base of all remarks on what was given: it can be used, and something about it should be known."""


class ConfigurationError(PotlpError):
    """A setting is missing, unknown or has a value that does not fit; the message names it and what can be given."""


class TaskError(PotlpError):
    """What is wrong with a task: its formula, its automaton or its propositions."""


class UnsatisfiableError(TaskError):
    """No word satisfies a task: its parts contradict each other."""


class TaskWarning(PotlpWarning):
    """A task can be used but asks for nothing."""


class SpotMissingError(TaskError):
    """A formula must be translated and the library Spot is not there; the message says how to install it."""


class PropositionsError(TaskError):
    """Two things that are to be joined are of other propositions, or of another order; the message names both."""


class WorldError(PotlpError):
    """A world, or the configuration of a world, is not valid; the message says what and where."""


class PluginError(PotlpError):
    """An environment, policy, camera or estimator cannot be found or loaded by its name; the message lists what can."""


class MapError(PotlpError):
    """A map, or what is placed in it, cannot be used: names the file, the field, and what to do."""

    def __init__(self, file: Path | str, field: str, message: str) -> None:
        super().__init__(f"{file}: {field}: {message}" if field else f"{file}: {message}")

    @classmethod
    def of_file(cls, file: Path | str, message: str) -> "MapError":
        """An error about a file as a whole."""
        return cls(file, "", message)


class MapWarning(PotlpWarning):
    """A map can be used but probably does not mean what it says."""


class ProblemError(PotlpError):
    """A planning problem holds a value that the model does not allow; the message names field, index and value."""


class EstimatesError(PotlpError):
    """What an estimator answered, or a caller gave, is not an array of estimates; the message names it and what is."""


class ProblemTooLargeError(PotlpError):
    """The problem has more states than the exact solver was allowed to explore."""


class NetworkError(PotlpError):
    """A network's configuration does not fit together, or does not fit what it is asked."""


class DatasetError(PotlpError):
    """A dataset cannot be read, or not be continued; the message says which file and what to do."""


class TrainingError(PotlpError):
    """The data cannot be trained on, or training has diverged; the message says what to do."""


class CheckpointError(PotlpError):
    """A training cannot resume from a checkpoint: damaged, or of another training; the message names what differs."""


class EstimatorError(PotlpError):
    """An estimator cannot be read, or does not fit what it is asked; the message names what differs."""


class ExportError(PotlpError):
    """An exported program cannot be read or called; the message names the file or the inputs."""


class EvaluationError(PotlpError):
    """An estimator cannot be evaluated on a data set; the message names what does not fit."""


class RecordError(PotlpError):
    """A file is not a trial record of this version; the message names the file and what is wrong."""


class BatchError(PotlpError):
    """Trials do not fit into one batch; the message says which and why."""


class SpecificationError(ConfigurationError):
    """A specification of a sweep cannot be used: names the file, the entry and what to do."""


class EngineError(PotlpError):
    """Work cannot be done where it was asked for: names the cluster and what to do."""


class SweepError(PotlpError):
    """A sweep has ended before its end; the message says why, and that what is finished is kept."""


class StoreError(PotlpError):
    """A store cannot be used: names the file, what is wrong, and what to do."""


class LogError(PotlpError):
    """A log cannot be used: names the file or topic, what is wrong, and what to do."""


class RobotError(PotlpError):
    """A robot broke its side of the contract, or cannot be reached; the message says what it did, and what is right."""


class PictureError(PotlpError):
    """A picture cannot be written as asked; the message names the file and what to do."""
