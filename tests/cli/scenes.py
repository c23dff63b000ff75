"""Scenes and experiments in files, as tests of commands write them."""

PNG = b"\x89PNG\r\n\x1a\n"
"""The first bytes of a PNG file."""


SCENE = "eta = 0.05\ndiameter = 2e-3\ndensity = 2500\nY = 5e7\nnu = 0.22\nT0 = 0.01\nA = 3e-6\n"


EXPERIMENT = """
[experiment]
times = {number = 10, first = 0.1, last = 10.0}
T_err = 0.02
N = 250
absent = ["walls", "drag"]
"""
