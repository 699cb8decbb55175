"""Basis of the daemon: what several of its processes and the `jtq` tools share.

Memory written by one and read by many (`ring`, `snapshot`, notices in `events`; layouts in `cycle_record` and `counters`),
files of the runtime directory (`runtime_dir`, `conditions`), child processes, lines for the operator (`events`), systemd.
Imports nothing else of the daemon.
"""
