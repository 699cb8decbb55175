"""The fault cases of docs/testing.md: injected on a real bus, with what jtqd said, counted and published, and when.

`rig` is the emulated bench with a hook between its nodes and the bus, `watcher` reads the bus and holds the invariants,
`injections` are the kinds of fault, `ears` an independent listener, `proofs` what it must have heard, `cases_*` the
table, `elsewhere` the cases that other tests show, `runner` plays them.
"""
