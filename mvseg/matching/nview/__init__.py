"""The default matcher: finds the partition of masks that explains best what all views show along the rays of each."""
