"""From photos alone to cameras with a scale and axes: structure from motion, turntables, and poses refined by masks."""
