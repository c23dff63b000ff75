"""Checks: validation of what a user gives, what is traced by JAX, and the status of compiled code.

The lowest floor: imports no other package of jaxgran, and every other package may import it.
"""
