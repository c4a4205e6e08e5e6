"""Services of the operating system and of Python: whole writes, hashes, signals, worker processes, late imports."""
