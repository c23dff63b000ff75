"""What several experiments share: gases, timing, files of results, parts of long scripts."""
