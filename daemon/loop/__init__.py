"""The loop process: SYNC, inputs, estimates and their status, the estimate PDO; one cycle a millisecond."""
