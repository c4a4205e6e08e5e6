"""Follows leaves over days: results of one plant on several dates, aligned and linked into tracks, and their growth."""
