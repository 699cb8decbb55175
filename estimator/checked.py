"""Names of errors, command_line and text under one module, for importers that have not moved yet."""

from __future__ import annotations

from jtqd.estimator.command_line import (
    check_installed,
    check_output,
    count,
    make_directory,
    natural,
    seconds,
    write_whole,
)
from jtqd.estimator.errors import ConfigError, Verbatim, in_unit, number_as_text, range_text, shown
from jtqd.estimator.text import counted, finite

__all__ = (
    "ConfigError",
    "Verbatim",
    "check_installed",
    "check_output",
    "count",
    "counted",
    "finite",
    "in_unit",
    "make_directory",
    "natural",
    "number_as_text",
    "range_text",
    "seconds",
    "shown",
    "write_whole",
)
