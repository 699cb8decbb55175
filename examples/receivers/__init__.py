"""Receivers of the estimate PDO, to be copied into a controller.

receive_estimate.py  decodes and prints, with python-can
jtqd_estimate.h      C99, one header: decode, sequence, age, and whether a torque may be used now
jtqd_estimate.hpp    the same for C++17
receive_estimate.c   a program with the C header on SocketCAN, with a safe reaction
"""
