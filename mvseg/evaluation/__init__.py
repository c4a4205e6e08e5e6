"""How right masks, ids and shapes are."""
