"""Findings: what the program noticed of its input, as data; sentences are made of them where somebody reads."""
