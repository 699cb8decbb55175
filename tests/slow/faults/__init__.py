"""The fault cases of docs/testing.md: injected on a real bus, with what jtqd reported, counted and published, and when.

`rig` is the emulated bench with a hook between its nodes and the bus, and the watcher that reads the bus and holds the
invariants; `injections` are the kinds of fault, `listener` an independent listener and what it must have heard, `cases` the
catalogue, `__main__` plays it.
"""
