"""The loop process: SYNC, inputs, estimates and their status, the estimate PDO; one cycle a millisecond.

In: frames of the bus. Out: one estimate PDO, one cycle record and every 8th cycle a snapshot (`cycle` is one cycle,
`process` the shell). May import `drivers`, `estimator`, `daemon.config`, `daemon.shared` and `daemon.reload.handover`.
"""
