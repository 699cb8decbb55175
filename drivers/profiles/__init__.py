"""Profiles of drive families for a section `joint_N` of the configuration: one YAML file per family.

Read by `jtqd.daemon.profiles`; docs/bus.md shows them as tables. Every line has its source and how far it is known.
"""
