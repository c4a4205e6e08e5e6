"""Measures what plant scientists want to know of leaves and of the whole plant, with standard deviations."""
