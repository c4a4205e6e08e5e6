"""The result folder: what a person looks at."""
