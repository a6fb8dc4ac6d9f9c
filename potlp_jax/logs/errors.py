"""What is wrong with a log."""


class LogError(ValueError):
    """A log cannot be used: names the file or topic, what is wrong, and what to do."""
