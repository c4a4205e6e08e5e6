"""Readers and writers, one file per format. Conventions are converted here and nowhere else."""
