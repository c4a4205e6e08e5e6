"""Stems as tubes: curves with a radius, fitted to masks that show them, or found between the bases of leaves."""
