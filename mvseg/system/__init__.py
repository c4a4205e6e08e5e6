"""What runs and files need of the operating system: whole writes and locks, signals, worker processes."""
