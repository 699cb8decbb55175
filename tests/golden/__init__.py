"""Golden logs: short recordings of the emulated bench, and what the estimator makes of them, see docs/logs.md."""
