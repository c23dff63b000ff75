"""Common parts of the experiments: gases, timing, files of results, parts of long scripts."""
