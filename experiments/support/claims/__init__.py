"""The claims that `paper/paper_claims.py` sets beside measurements, by subject."""
