"""The bench kernel: user-mode Linux with SocketCAN, where the host has none (docs/bench_kernel.md)."""
