"""What is wrong with a log, and what may be."""


class LogError(ValueError):
    """A log cannot be used: names the file or topic, what is wrong, and what to do."""


class LogWarning(UserWarning):
    """A log can be used, but something was lost or probably does not mean what it says."""
