"""The rows of the documents: what was measured in words, out of the files in `figures/`."""
