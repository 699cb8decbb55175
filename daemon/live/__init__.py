"""What viewers get of jtqd: the layout for Foxglove and Lichtblick, and the live view of a running daemon."""
