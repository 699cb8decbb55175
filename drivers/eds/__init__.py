"""Electronic data sheets (CiA 306): the .eds files of the bench's drive and torque sensor and of jtqd's own node.

`python -m tools.eds` writes them from its tables; `own_objects` names the sub-indices of jtqd's objects for the daemon.
"""
