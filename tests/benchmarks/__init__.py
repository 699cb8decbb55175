"""Benchmarks of jtqd: `make bench`, or `python -m tests.benchmarks [cycle|stages|grid|start] [--quick] [--json]`."""
