"""What would go wrong with a scene, found before anything long runs."""
