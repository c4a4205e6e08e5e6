"""What plant scientists measure: traits of leaves and of the whole plant, with their uncertainty."""
