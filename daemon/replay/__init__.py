"""Replay: the estimator over a log again, bit for bit as it was or with other models (`docs/logs.md`).

In come logs of jtqd; out go estimates, their differences to the logged ones, and an MCAP with both. Call `session.replay`.
May import `daemon.logs`, `daemon.config`, `daemon.core`, `daemon.recording` and `estimator`.
"""
