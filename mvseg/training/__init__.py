"""Training and fine-tuning of a detector that sees one photo at a time."""
