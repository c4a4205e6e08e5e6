"""Services of the operating system: atomic writes and locks, signals, worker processes."""
