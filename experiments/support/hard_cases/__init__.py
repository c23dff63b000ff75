"""The hard cases of `accuracy/hard_cases.py`, by what goes to its limit."""
