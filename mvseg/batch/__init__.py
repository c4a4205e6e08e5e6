"""Runs many scenes: their list, workers on this machine or a cluster, what is resumed, and the joined tables."""
