"""Logs read back: messages as arrays, attachments, tables and frames for other programs, recovery after a crash.

In come MCAP files of jtqd, its python-can writer and others; out go numpy arrays, CSV, Parquet, candump lines, whole files.
May import numpy, mcap and the file format of `daemon.recording`; import `recover`, `export`, `can_io` by name.
"""

from jtqd.daemon.logs.log_file import LogError, LogFile
from jtqd.daemon.logs.read import (
    Messages,
    Records,
    iter_messages,
    iter_topics,
    log_parts,
    read_attachments,
    read_messages,
    read_topic,
    read_topics,
    rmse,
    shadow_errors,
    topics_of,
)
from jtqd.daemon.logs.table import Table

__all__ = [
    "LogError",
    "LogFile",
    "Messages",
    "Records",
    "Table",
    "iter_messages",
    "iter_topics",
    "log_parts",
    "read_attachments",
    "read_messages",
    "read_topic",
    "read_topics",
    "rmse",
    "shadow_errors",
    "topics_of",
]
