"""A detector that sees all views of a scene at once (Sec. 3.2)."""
