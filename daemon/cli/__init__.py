"""Commands of `jtq` about a bus or a running daemon."""
