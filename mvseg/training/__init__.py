"""Fine-tuning a single-view detector."""
