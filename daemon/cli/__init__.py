"""Commands of `jtq` about a bus, a daemon, this machine: init, probe, status, control, check, doctor, bus-load, completion.

In: command-line arguments, a bus, runtime directories of daemons. Out: text or JSON on standard output, an exit status.
May import daemon, drivers, estimator and models. `checks` holds the result of a check and its report, for all of them.
"""
