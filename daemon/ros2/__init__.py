"""ROS 2 publisher: joint states, diagnostics and torque states as DDS topics that ROS 2 nodes subscribe to, without ROS.

In comes the loop's shared memory, read-only; out go DDS messages with the types and names of ROS 2 (extra `ros2`).
May import `daemon.shared`, `daemon.config` and `daemon.recording`; entry points: `keeper` (supervisor), `process`.
"""
