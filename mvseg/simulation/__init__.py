"""Plants with known answers: grown leaf by leaf, photographed by ray casting, written as scenes and data sets."""
