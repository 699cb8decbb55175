"""The bench kernel: Linux as an ordinary process (user-mode Linux) with SocketCAN, where the host has none.

A command goes in, its exit status and output come out; `build` makes the kernel once per machine, `guest` boots it.
Imports the standard library only. docs/testing.md states what it is and what it cannot do.
"""
