"""`report.html`: the result as one page that opens offline."""
