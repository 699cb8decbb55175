"""Frame sockets, PDO codec, CANopen devices and boot: everything between a wire and numbers."""
