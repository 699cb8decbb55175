"""Faults of inputs, timing and nodes at a gateway, each estimate judged by the true torque; a catalogue of faults on a bus.

`gateway` changes what nodes send, `table` has the faults, `runs` the plants, `trial` runs jtqd in exact time and judges.
`on_bus` plays the catalogue `cases`: `rig` is the emulated bench on a real bus with a hook between its nodes and the bus,
and a watcher of all that jtqd sends; `injections` are kinds of fault, `listener` hears the bus by itself.
"""
