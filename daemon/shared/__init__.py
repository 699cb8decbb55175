"""What several processes read: records, counters and notices in shared memory, and what describes a running daemon."""
