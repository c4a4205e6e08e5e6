"""Many scenes: their list, workers on this machine or a cluster, resume, and the joined tables."""
