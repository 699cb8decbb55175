"""Recording: from the ring of cycles to MCAP files, by a process of its own that only reads shared memory.

In come cycle records and a request; out go the files of a run (`parts`, `mcap_file`) and an account of every cycle.
May import `daemon.shared`, `daemon.config`, `drivers`. Entry points: `launch`, `recorder` (process), `messages`.
"""
