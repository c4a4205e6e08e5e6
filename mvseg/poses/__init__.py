"""From photos alone to cameras with a scale and axes: structure from motion, and what fixes its free similarity."""
