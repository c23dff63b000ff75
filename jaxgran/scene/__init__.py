"""The scene: the gas, its law of restitution, the contact force and the geometry of spheres.

Imports `checks` only; every package above may import it.
"""
