"""Stage 2b: who makes regions from images."""
