"""The claims that `paper/paper_claims.py` compares with measurements, by subject."""
