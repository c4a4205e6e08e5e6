"""A detector fine-tuned on the photos at hand, with the other views in place of an annotator."""
