"""Ground floor of the daemon: what several of its processes and the `jtq` tools share.

Memory written by one and read by many (`ring`, `snapshot`, `notices`; layout in `cycle_record`), files of the runtime
directory (`runtime_dir`, `conditions`), child processes, lines for the operator (`log_lines`), systemd. Imports nothing else
of the daemon.
"""
