"""Finds leaves in all photos of a scene at once: proposals, matched, thinned across views (Sec. 3.2), chosen."""
