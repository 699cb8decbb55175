"""New joint files, networks and settings in a running daemon, without a late or missing cycle.

In: the files named by the configuration and the running loop. Out: a successor process that holds the bus and goes on.
Imports daemon.config, daemon.core, daemon.shared and daemon.loop, drivers and estimator.
"""
