"""Stage 2a: readers and writers, one file per format. Every conversion of convention lives here and nowhere else."""
