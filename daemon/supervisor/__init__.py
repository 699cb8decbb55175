"""The supervisor process: children, systemd, control socket, and every line that an operator sees."""
