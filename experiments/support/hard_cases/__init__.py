"""The hard cases of `accuracy/hard_cases.py`: impacts, gases and runs."""
