"""Region matching: masks and cameras in, instance ids out."""
