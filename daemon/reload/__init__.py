"""New joint files, networks and settings in a running daemon, without a late or missing cycle.

In: the files named by the configuration and the ring of cycles. Out: estimators as flat blocks, swapped by the running loop
between two cycles. Imports daemon.config, daemon.core, daemon.shared and daemon.loop, and estimator.
"""
