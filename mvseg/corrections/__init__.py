"""What a person corrects in the photos of a scene, and what a run makes of it."""
