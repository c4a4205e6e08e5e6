"""Builds `report.html`: the result as one page that opens offline, and what the page needs for correcting."""
