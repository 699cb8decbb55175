"""jtqd: configuration, fixed-step loop, recorder, supervision and the command lines."""
