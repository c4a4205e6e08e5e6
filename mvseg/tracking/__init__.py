"""The same leaf over days: results of one plant on several dates, aligned and linked into tracks."""
