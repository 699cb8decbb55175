"""From the ring of cycles to MCAP files: what is recorded, its bytes, the files, and the process that writes them."""
