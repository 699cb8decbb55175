"""Fuzzers: frames through the loop and the supervisor, a running daemon in a storm, damaged files (docs/testing.md)."""
