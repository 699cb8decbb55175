"""Joint files, configurations and trained artifacts that ship, and the one reader of them."""
