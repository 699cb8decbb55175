"""The supervisor: the process `jtqd` itself, which starts bench, loop, boot and recorder and ends them in order.

In: configuration, snapshot, requests on the control socket and by signals. Out: conditions and their lines, metrics, live
table, summary (`process` runs it all). May import every part of the daemon but `cli`, `logs` and `replay`.
"""
