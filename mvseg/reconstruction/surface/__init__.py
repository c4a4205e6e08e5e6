"""A leaf as a spline surface, fitted to the outlines of its masks in all views."""
