"""The result folder and the page in it."""
