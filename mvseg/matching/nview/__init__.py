"""Matching by what all views show along the rays of each region."""
