"""Whole commands: opens what lies in a folder, hands it to the stages, and writes a result that can be repeated."""
