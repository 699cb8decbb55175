"""The loop process: what is built at the start, one cycle (`daemon.core`) after the other, and the duties between them.

In: frames of the bus. Out: one estimate PDO, one cycle record and every 8th cycle a snapshot. May import `drivers`,
`estimator`, `daemon.config`, `daemon.core`, `daemon.shared`.
"""
