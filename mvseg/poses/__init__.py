"""From photos alone to cameras with a scale and axes: structure from motion, frames of films, turntables, lenses."""
