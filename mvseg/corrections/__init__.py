"""Reads what the user says is wrong, applies it to the masks of a scene, and ranks what else is worth asking about."""
