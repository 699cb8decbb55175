"""Replay: the estimator over a log again, bit for bit as it was or with other models (`docs/replay.md`)."""
