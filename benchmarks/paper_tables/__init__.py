"""The paper's experiments, tables 1 to 3 and the question of |k|: `python -m benchmarks.paper_tables`."""
