"""The one error of everything that reads logs."""


class LogError(ValueError):
    """The log cannot be used; one line: file, topic, found, expected."""
