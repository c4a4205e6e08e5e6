"""Trains and fine-tunes a detector that sees one photo at a time, on files, rendered plants or a plant's own leaves."""
