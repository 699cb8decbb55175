"""CANopen nodes of the `canopen` library (LocalNode): drives and a sensor that share no code with jtqd or its bench."""
