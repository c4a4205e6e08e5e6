"""How good masks, ids and shapes are."""
