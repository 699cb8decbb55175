"""New joint files, networks and settings in a running daemon, without a late or missing cycle."""
