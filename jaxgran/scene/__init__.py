"""The scene: the gas, its law of restitution, the contact force and the geometry of spheres.

This package imports only `jaxgran._utils`; every package above may import it.
"""
